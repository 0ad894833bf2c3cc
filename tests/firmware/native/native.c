/* The core driven natively, for sanitizers, coverage and benchmarks.

     storm N SEED    N ticks of a host that mixes right and wrong requests, old commands and garbage; ends with an
                     error where the drive leaves the limit, is on outside a session, or memory beside the core changes
     bits            every 1- and 2-bit error of every message, several bodies each: accepted, of how many
     errors N SEED   N frames with three bits flipped, and N of garbage: accepted, of how many
     codec N         frames encoded and decoded a second  */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "core.h"
#include "frame.h"

static uint32_t seed = 1;

static uint32_t draw(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 17;
    seed ^= seed << 5;
    return seed;
}

static uint32_t below(uint32_t n) { return draw() % n; }

/* ---- storm ---- */

enum { CANARY = 0xa5, BESIDE = 64, LIMIT = 150, OLD = 64 };

static struct {
    uint8_t before[BESIDE];
    station_core core;
    uint8_t after[BESIDE];
} guarded;

static station_core *const core = &guarded.core;
static uint8_t old_frames[OLD][16];
static uint32_t old_count;

static void give(const uint8_t *body, uint16_t length, uint16_t session)
{
    uint8_t wire[160];
    uint16_t size = station_encode(body, length, session, wire);
    if (body[0] == STATION_CODE_COMMAND) {
        memcpy(old_frames[old_count++ % OLD], wire, size);
    }
    if (below(50) == 0) {
        wire[below(size)] ^= (uint8_t)(1u << below(8));
    }
    if (below(60) == 0) {
        size = (uint16_t)below(size);
    }
    station_receive(core, wire, size);
}

static void request(void)
{
    uint8_t body[STATION_FRAME_BYTES];
    const uint32_t wrong = below(12);
    const station_identify identify = {.version = STATION_PROTOCOL_VERSION, .hash = STATION_PROTOCOL_HASH - !wrong};
    station_configure configure = {
        .rate = 500000,
        .command_limit = (int16_t)(LIMIT - below(3) + (wrong == 1) * 4u),
        .hold_ticks = (uint8_t)below(6),
        .fault_ticks = (uint8_t)(6 + below(20)),
        .answer_ticks = (uint8_t)(1 + below(4)),
        .travel_limit = below(2) * 2000,
        .speed_limit = (uint16_t)(below(2) * 300),
        .stall_command = (int16_t)(below(2) * 100),
    };
    configure.stall_time = configure.stall_command ? 40 : 0;
    const station_arm arm = {.challenge = core->challenge - !wrong};
    const station_start start = {.session = (uint16_t)below(0x10000), .challenge = core->challenge - !wrong};
    switch (below(8)) {
    case 0: station_pack_identify(&identify, body); give(body, STATION_BODY_IDENTIFY, 0); break;
    case 1: station_pack_configure(&configure, body); give(body, STATION_BODY_CONFIGURE, 0); break;
    case 2: station_pack_arm(&arm, body); give(body, STATION_BODY_ARM, 0); break;
    case 3: station_pack_start(&start, body); give(body, STATION_BODY_START, 0); break;
    default: body[0] = (uint8_t)(STATION_CODE_STOP + below(4)); give(body, 1, 0); break;
    }
}

/* On the way to a run, as a host would go. */
static void begin(void)
{
    uint8_t body[STATION_FRAME_BYTES];
    const station_identify identify = {.version = STATION_PROTOCOL_VERSION, .hash = STATION_PROTOCOL_HASH};
    const station_configure configure = {.rate = 500000, .command_limit = LIMIT, .hold_ticks = 1, .fault_ticks = 10,
                                         .answer_ticks = (uint8_t)(1 + below(4))};
    body[0] = STATION_CODE_CLEAR;
    give(body, 1, 0);
    station_pack_identify(&identify, body);
    give(body, STATION_BODY_IDENTIFY, 0);
    station_pack_configure(&configure, body);
    give(body, STATION_BODY_CONFIGURE, 0);
    const station_arm arm = {.challenge = core->challenge};
    station_pack_arm(&arm, body);
    give(body, STATION_BODY_ARM, 0);
    const station_start start = {.session = (uint16_t)(1 + below(0xffff)), .challenge = core->challenge};
    station_pack_start(&start, body);
    give(body, STATION_BODY_START, 0);
}

static void command(void)
{
    uint8_t body[STATION_BODY_COMMAND];
    const int32_t ahead = below(4) ? core->config.answer_ticks - 1 : (int32_t)below(24) - 12;
    const station_command wanted = {.index = (uint16_t)(core->next_index + ahead), .command = (int16_t)below(0x10000)};
    station_pack_command(&wanted, body);
    give(body, sizeof body, below(20) ? core->session : (uint16_t)below(0x10000));
}

static void garbage(void)
{
    uint8_t bytes[300];
    const uint16_t count = (uint16_t)below(sizeof bytes);
    for (uint16_t i = 0; i < count; i++) {
        bytes[i] = (uint8_t)below(below(3) ? 256 : 8);
    }
    station_receive(core, bytes, count);
}

static int fail(const char *what, uint32_t tick)
{
    printf("tick %u: %s (state %u, drive %d)\n", tick, what, core->state, core->drive);
    return 1;
}

static int storm(uint32_t ticks)
{
    const station_board board = {.boot = 1, .clock_hz = 1000000, .rate_min = 100000, .rate_max = 500000,
                                 .command_limit = LIMIT, .stall_command = 120, .stall_time = 100, .name = "storm"};
    uint8_t line[STATION_TRANSMIT_BYTES];
    int32_t encoder = 0;
    memset(&guarded, CANARY, sizeof guarded);
    station_init(core, &board, draw());
    uint32_t driven = 0, faults = 0;
    for (uint32_t tick = 0; tick < ticks; tick++) {
        const uint32_t what = below(1000);
        if (what < 8 && core->state != STATION_STATE_RUNNING) {
            begin();
        } else if (what < 20) {
            request();
        } else if (what < 26) {
            garbage();
        } else if (what < 32) {
            station_receive(core, old_frames[below(OLD)], 9);
        } else if (what < 985) {
            command();
        }
        station_input input = {.clock = tick * 2000, .encoder = encoder, .accel = (int16_t)below(0x10000)};
        input.flags = (uint16_t)(below(3000) ? 0u : 1u << below(4));
        station_output output;
        const uint8_t before = core->state;
        station_tick(core, &input, &output);
        encoder = (int32_t)((uint32_t)encoder + (uint32_t)(output.drive / 40) + (below(500) ? 0 : below(4000)));
        driven += output.drive != 0;
        faults += core->state == STATION_STATE_FAULT && before != STATION_STATE_FAULT;
        (void)station_transmit(core, line, (uint16_t)below(below(20) ? STATION_TRANSMIT_BYTES + 1 : 8));
        if (output.drive > LIMIT || output.drive < -LIMIT) {
            return fail("beyond the limit", tick);
        }
        if (!output.enable && output.drive != 0) {
            return fail("driven, not enabled", tick);
        }
        if (output.enable != (core->state == STATION_STATE_RUNNING)) {
            return fail("enabled outside a session", tick);
        }
        if (core->transmit > STATION_TRANSMIT_BYTES || core->received > STATION_FRAME_BYTES) {
            return fail("a buffer beyond its end", tick);
        }
        for (uint32_t i = 0; i < BESIDE; i++) {
            if (guarded.before[i] != CANARY || guarded.after[i] != CANARY) {
                return fail("memory beside the core has changed", tick);
            }
        }
    }
    printf("%u ticks, %u driven, %u faults\n", ticks, driven, faults);
    return driven < ticks / 10 || faults < ticks / 20000;
}

/* ---- errors of bits ---- */

static const uint8_t codes[] = {
    STATION_CODE_IDENTIFY, STATION_CODE_CONFIGURE, STATION_CODE_ARM, STATION_CODE_START, STATION_CODE_COMMAND,
    STATION_CODE_STOP, STATION_CODE_CLEAR, STATION_CODE_ZERO, STATION_CODE_QUERY, STATION_CODE_IDENTITY,
    STATION_CODE_REPLY, STATION_CODE_SAMPLE, STATION_CODE_FAULT, STATION_CODE_STATISTICS,
};

/* Whether any frame in these bytes passes, as the core and the host would take it. */
static int passes(const uint8_t *bytes, uint16_t count, uint16_t session)
{
    uint8_t frame[STATION_FRAME_BYTES * 2];
    uint16_t length = 0;
    for (uint16_t i = 0; i < count; i++) {
        if (bytes[i] != 0) {
            frame[length++] = bytes[i];
            continue;
        }
        const uint8_t scoped = frame[1] == STATION_CODE_COMMAND || frame[1] == STATION_CODE_SAMPLE;
        const uint16_t raw = length < 2 ? 0 : station_decode(frame, length, scoped ? session : 0);
        length = 0;
        if (raw > 0 && station_body_size(frame[0]) == raw) {
            return 1;
        }
    }
    return 0;
}

static uint16_t some_frame(uint8_t code, uint32_t zeros, uint8_t *wire, uint16_t *session)
{
    uint8_t body[STATION_FRAME_BYTES];
    const uint16_t length = station_body_size(code);
    const uint8_t scoped = code == STATION_CODE_COMMAND || code == STATION_CODE_SAMPLE;
    body[0] = code;
    for (uint16_t i = 1; i < length; i++) {
        body[i] = below(100) < zeros ? 0 : (uint8_t)draw();
    }
    *session = (uint16_t)(1 + below(0xffff));
    const uint16_t size = station_encode(body, length, scoped ? *session : 0, wire);
    wire[size] = 0; /* the next delimiter, should this one be hit */
    return size;
}

static int bits(uint32_t bodies)
{
    uint8_t wire[STATION_FRAME_BYTES * 2];
    uint16_t session;
    uint64_t accepted[2] = {0, 0}, tried[2] = {0, 0};
    for (uint32_t k = 0; k < sizeof codes; k++) {
        for (uint32_t body = 0; body < bodies; body++) {
            const uint16_t size = some_frame(codes[k], 20 * (body % 5), wire, &session);
            for (uint32_t a = 0; a < size * 8u; a++) {
                wire[a / 8] ^= (uint8_t)(1u << a % 8);
                accepted[0] += (uint64_t)passes(wire, (uint16_t)(size + 1), session);
                tried[0]++;
                for (uint32_t b = 0; b < a; b++) {
                    wire[b / 8] ^= (uint8_t)(1u << b % 8);
                    accepted[1] += (uint64_t)passes(wire, (uint16_t)(size + 1), session);
                    tried[1]++;
                    wire[b / 8] ^= (uint8_t)(1u << b % 8);
                }
                wire[a / 8] ^= (uint8_t)(1u << a % 8);
            }
        }
    }
    printf("%llu of %llu one-bit errors accepted, %llu of %llu two-bit errors\n", (unsigned long long)accepted[0],
           (unsigned long long)tried[0], (unsigned long long)accepted[1], (unsigned long long)tried[1]);
    return accepted[0] + accepted[1] > 0;
}

static int errors(uint32_t count)
{
    uint8_t wire[STATION_FRAME_BYTES * 2];
    uint16_t session = 1;
    uint64_t three = 0, junk = 0;
    for (uint32_t i = 0; i < count; i++) {
        const uint16_t size = some_frame(codes[i % sizeof codes], 30, wire, &session);
        uint32_t at[3];
        at[0] = below(size * 8u);
        do {
            at[1] = below(size * 8u);
        } while (at[1] == at[0]);
        do {
            at[2] = below(size * 8u);
        } while (at[2] == at[0] || at[2] == at[1]);
        for (uint32_t j = 0; j < 3; j++) {
            wire[at[j] / 8] ^= (uint8_t)(1u << at[j] % 8);
        }
        three += (uint64_t)passes(wire, (uint16_t)(size + 1), session);
        /* garbage that has a frame's shape: a message's code and length, bytes of check that could be some */
        const uint16_t length = some_frame(codes[below(sizeof codes)], 0, wire, &session);
        for (uint16_t j = 2; j < length - 4; j++) {
            wire[j] = (uint8_t)(1 + below(255));
        }
        wire[0] = (uint8_t)(length - 4);
        wire[length - 4] = (uint8_t)(0x40 + below(64));
        wire[length - 3] = (uint8_t)(0x40 + below(32));
        wire[length - 2] = (uint8_t)(0x40 + below(32));
        junk += (uint64_t)passes(wire, length, session);
    }
    printf("%llu of %u with three bits flipped accepted, %llu of %u of garbage with the right shape; "
           "2 x 2^-16 of them is %.0f\n", (unsigned long long)three, count, (unsigned long long)junk, count,
           2.0 * count / 65536.0);
    return three > 2.0 * count / 65536.0 + 4.0 || junk > 2.0 * count / 65536.0 + 4.0;
}

/* ---- codec ---- */

static int codec(uint32_t count)
{
    uint8_t body[STATION_BODY_SAMPLE], wire[64], back[64];
    uint32_t sum = 0;
    const clock_t begun = clock();
    for (uint32_t i = 0; i < count; i++) {
        const station_sample sample = {.index = (uint16_t)i, .clock = i * 2000, .encoder = (int32_t)i, .accel = 7};
        station_sample read;
        station_pack_sample(&sample, body);
        const uint16_t size = station_encode(body, sizeof body, 4711, wire);
        memcpy(back, wire, size);
        if (station_decode(back, (uint16_t)(size - 1), 4711) != sizeof body) {
            return 1;
        }
        station_unpack_sample(back, &read);
        sum += read.index;
    }
    const double seconds = (double)(clock() - begun) / CLOCKS_PER_SEC;
    printf("%.0f frames/s packed, encoded, decoded and unpacked (%u)\n", count / seconds, sum);
    return 0;
}

int main(int argc, char **argv)
{
    const uint32_t count = argc > 2 ? (uint32_t)strtoul(argv[2], NULL, 10) : 1;
    seed = argc > 3 ? (uint32_t)strtoul(argv[3], NULL, 10) : 1;
    if (argc < 2) {
        return 2;
    }
    return strcmp(argv[1], "storm") == 0    ? storm(count)
           : strcmp(argv[1], "bits") == 0   ? bits(count)
           : strcmp(argv[1], "errors") == 0 ? errors(count)
           : strcmp(argv[1], "codec") == 0  ? codec(count)
                                            : 2;
}
