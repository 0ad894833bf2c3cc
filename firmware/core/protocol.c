/* Written by `python -m station.device.header` from firmware/protocol.toml.  Do not edit. */

#include "protocol.h"

#include <string.h>

static void put8(uint8_t *to, uint8_t value) { to[0] = value; }

static void put16(uint8_t *to, uint16_t value)
{
    to[0] = (uint8_t)(value & 0xffu);
    to[1] = (uint8_t)(value >> 8);
}

static void put32(uint8_t *to, uint32_t value)
{
    put16(to, (uint16_t)(value & 0xffffu));
    put16(to + 2, (uint16_t)(value >> 16));
}

static uint8_t get8(const uint8_t *from) { return from[0]; }

static uint16_t get16(const uint8_t *from)
{
    return (uint16_t)(from[0] | ((uint32_t)from[1] << 8));
}

static uint32_t get32(const uint8_t *from)
{
    return get16(from) | ((uint32_t)get16(from + 2) << 16);
}

/* Two's complement without the conversions that C leaves to the compiler. */
static int16_t signed16(uint16_t value)
{
    return (int16_t)(value < 0x8000u ? (int32_t)value : (int32_t)value - 0x10000);
}

static int32_t signed32(uint32_t value)
{
    return value < 0x80000000u ? (int32_t)value : -(int32_t)(0xffffffffu - value) - 1;
}

void station_pack_identify(const station_identify *in, uint8_t *body)
{
    body[0] = STATION_CODE_IDENTIFY;
    put16(body + 1, in->version);
    put32(body + 3, in->hash);
    put16(body + 7, in->nonce);
}

void station_unpack_identify(const uint8_t *body, station_identify *out)
{
    out->version = get16(body + 1);
    out->hash = get32(body + 3);
    out->nonce = get16(body + 7);
}

void station_pack_configure(const station_configure *in, uint8_t *body)
{
    body[0] = STATION_CODE_CONFIGURE;
    put32(body + 1, in->rate);
    put16(body + 5, (uint16_t)in->command_limit);
    put8(body + 7, in->hold_ticks);
    put8(body + 8, in->fault_ticks);
    put8(body + 9, in->answer_ticks);
    put32(body + 10, in->travel_limit);
    put16(body + 14, in->speed_limit);
    put16(body + 16, (uint16_t)in->stall_command);
    put16(body + 18, in->stall_time);
}

void station_unpack_configure(const uint8_t *body, station_configure *out)
{
    out->rate = get32(body + 1);
    out->command_limit = signed16(get16(body + 5));
    out->hold_ticks = get8(body + 7);
    out->fault_ticks = get8(body + 8);
    out->answer_ticks = get8(body + 9);
    out->travel_limit = get32(body + 10);
    out->speed_limit = get16(body + 14);
    out->stall_command = signed16(get16(body + 16));
    out->stall_time = get16(body + 18);
}

void station_pack_arm(const station_arm *in, uint8_t *body)
{
    body[0] = STATION_CODE_ARM;
    put32(body + 1, in->challenge);
}

void station_unpack_arm(const uint8_t *body, station_arm *out)
{
    out->challenge = get32(body + 1);
}

void station_pack_start(const station_start *in, uint8_t *body)
{
    body[0] = STATION_CODE_START;
    put16(body + 1, in->session);
    put32(body + 3, in->challenge);
}

void station_unpack_start(const uint8_t *body, station_start *out)
{
    out->session = get16(body + 1);
    out->challenge = get32(body + 3);
}

void station_pack_command(const station_command *in, uint8_t *body)
{
    body[0] = STATION_CODE_COMMAND;
    put16(body + 1, in->index);
    put16(body + 3, (uint16_t)in->command);
}

void station_unpack_command(const uint8_t *body, station_command *out)
{
    out->index = get16(body + 1);
    out->command = signed16(get16(body + 3));
}

void station_pack_identity(const station_identity *in, uint8_t *body)
{
    body[0] = STATION_CODE_IDENTITY;
    put16(body + 1, in->version);
    put32(body + 3, in->hash);
    put16(body + 7, in->nonce);
    put32(body + 9, in->challenge);
    put32(body + 13, in->boot);
    put16(body + 17, in->zeroings);
    put32(body + 19, in->clock_hz);
    put32(body + 23, in->rate_min);
    put32(body + 27, in->rate_max);
    put16(body + 31, (uint16_t)in->command_limit);
    put32(body + 33, in->travel_limit);
    put16(body + 37, in->speed_limit);
    put16(body + 39, (uint16_t)in->stall_command);
    put16(body + 41, in->stall_time);
    put32(body + 43, in->baud_rate);
    put16(body + 47, in->allowance);
    put16(body + 49, in->flags);
    put32(body + 51, in->build);
    put8(body + 55, in->reset);
    put8(body + 56, in->state);
    memcpy(body + 57, in->board, 16);
}

void station_unpack_identity(const uint8_t *body, station_identity *out)
{
    out->version = get16(body + 1);
    out->hash = get32(body + 3);
    out->nonce = get16(body + 7);
    out->challenge = get32(body + 9);
    out->boot = get32(body + 13);
    out->zeroings = get16(body + 17);
    out->clock_hz = get32(body + 19);
    out->rate_min = get32(body + 23);
    out->rate_max = get32(body + 27);
    out->command_limit = signed16(get16(body + 31));
    out->travel_limit = get32(body + 33);
    out->speed_limit = get16(body + 37);
    out->stall_command = signed16(get16(body + 39));
    out->stall_time = get16(body + 41);
    out->baud_rate = get32(body + 43);
    out->allowance = get16(body + 47);
    out->flags = get16(body + 49);
    out->build = get32(body + 51);
    out->reset = get8(body + 55);
    out->state = get8(body + 56);
    memcpy(out->board, body + 57, 16);
}

void station_pack_reply(const station_reply *in, uint8_t *body)
{
    body[0] = STATION_CODE_REPLY;
    put8(body + 1, in->request);
    put8(body + 2, in->result);
    put8(body + 3, in->state);
    put8(body + 4, in->fault);
    put16(body + 5, in->status);
    put32(body + 7, (uint32_t)in->encoder);
}

void station_unpack_reply(const uint8_t *body, station_reply *out)
{
    out->request = get8(body + 1);
    out->result = get8(body + 2);
    out->state = get8(body + 3);
    out->fault = get8(body + 4);
    out->status = get16(body + 5);
    out->encoder = signed32(get32(body + 7));
}

void station_pack_sample(const station_sample *in, uint8_t *body)
{
    body[0] = STATION_CODE_SAMPLE;
    put16(body + 1, in->index);
    put32(body + 3, in->clock);
    put32(body + 7, (uint32_t)in->encoder);
    put16(body + 11, (uint16_t)in->accel);
    put16(body + 13, (uint16_t)in->command);
    put16(body + 15, in->status);
}

void station_unpack_sample(const uint8_t *body, station_sample *out)
{
    out->index = get16(body + 1);
    out->clock = get32(body + 3);
    out->encoder = signed32(get32(body + 7));
    out->accel = signed16(get16(body + 11));
    out->command = signed16(get16(body + 13));
    out->status = get16(body + 15);
}

void station_pack_fault(const station_fault *in, uint8_t *body)
{
    body[0] = STATION_CODE_FAULT;
    put8(body + 1, in->fault);
    put16(body + 2, in->index);
}

void station_unpack_fault(const uint8_t *body, station_fault *out)
{
    out->fault = get8(body + 1);
    out->index = get16(body + 2);
}

void station_pack_statistics(const station_statistics *in, uint8_t *body)
{
    body[0] = STATION_CODE_STATISTICS;
    put8(body + 1, in->state);
    put8(body + 2, in->fault);
    put16(body + 3, in->status);
    put32(body + 5, (uint32_t)in->encoder);
    put32(body + 9, in->samples);
    put32(body + 13, in->unsent_samples);
    put32(body + 17, in->unsent_frames);
    put32(body + 21, in->commands);
    put32(body + 25, in->held);
    put32(body + 29, in->zeroed);
    put32(body + 33, in->late);
    put32(body + 37, in->early);
    put32(body + 41, in->repeated);
    put32(body + 45, in->out_of_window);
    put32(body + 49, in->limited);
    put32(body + 53, in->corrupt);
    put32(body + 57, in->woke_late);
    put32(body + 61, in->overruns);
    put32(body + 65, in->refused);
    put32(body + 69, in->faults);
}

void station_unpack_statistics(const uint8_t *body, station_statistics *out)
{
    out->state = get8(body + 1);
    out->fault = get8(body + 2);
    out->status = get16(body + 3);
    out->encoder = signed32(get32(body + 5));
    out->samples = get32(body + 9);
    out->unsent_samples = get32(body + 13);
    out->unsent_frames = get32(body + 17);
    out->commands = get32(body + 21);
    out->held = get32(body + 25);
    out->zeroed = get32(body + 29);
    out->late = get32(body + 33);
    out->early = get32(body + 37);
    out->repeated = get32(body + 41);
    out->out_of_window = get32(body + 45);
    out->limited = get32(body + 49);
    out->corrupt = get32(body + 53);
    out->woke_late = get32(body + 57);
    out->overruns = get32(body + 61);
    out->refused = get32(body + 65);
    out->faults = get32(body + 69);
}

/* Bytes of code and fields; 0: no such message. */
uint8_t station_body_size(uint8_t code)
{
    switch (code) {
    case STATION_CODE_IDENTIFY: return STATION_BODY_IDENTIFY;
    case STATION_CODE_CONFIGURE: return STATION_BODY_CONFIGURE;
    case STATION_CODE_ARM: return STATION_BODY_ARM;
    case STATION_CODE_START: return STATION_BODY_START;
    case STATION_CODE_COMMAND: return STATION_BODY_COMMAND;
    case STATION_CODE_STOP: return STATION_BODY_STOP;
    case STATION_CODE_CLEAR: return STATION_BODY_CLEAR;
    case STATION_CODE_ZERO: return STATION_BODY_ZERO;
    case STATION_CODE_QUERY: return STATION_BODY_QUERY;
    case STATION_CODE_IDENTITY: return STATION_BODY_IDENTITY;
    case STATION_CODE_REPLY: return STATION_BODY_REPLY;
    case STATION_CODE_SAMPLE: return STATION_BODY_SAMPLE;
    case STATION_CODE_FAULT: return STATION_BODY_FAULT;
    case STATION_CODE_STATISTICS: return STATION_BODY_STATISTICS;
    default: return 0;
    }
}
