#include "core.h"

#include <string.h>

#include "frame.h"

enum { WIRE_MARGIN = 4 /* CRC, COBS, delimiter */, BODY_MAX = STATION_FRAME_BYTES - WIRE_MARGIN };

/* ---- states ---- */

enum { STATES = 4, REFUSED = 0xff };

typedef enum { IDENTIFY, CONFIGURE, ARM, START, STOP, CLEAR, ZERO, FAIL, EVENTS } event;

/* The state after an event.  Whatever leaves `running` takes the drive to zero. */
static const uint8_t after[STATES][EVENTS] = {
    [STATION_STATE_IDLE] = {
        [IDENTIFY] = STATION_STATE_IDLE,
        [CONFIGURE] = STATION_STATE_IDLE,
        [ARM] = STATION_STATE_ARMED,
        [START] = REFUSED,
        [STOP] = STATION_STATE_IDLE,
        [CLEAR] = STATION_STATE_IDLE,
        [ZERO] = STATION_STATE_IDLE,
        [FAIL] = STATION_STATE_FAULT,
    },
    [STATION_STATE_ARMED] = {
        [IDENTIFY] = STATION_STATE_IDLE,
        [CONFIGURE] = REFUSED,
        [ARM] = STATION_STATE_ARMED,
        [START] = STATION_STATE_RUNNING,
        [STOP] = STATION_STATE_IDLE,
        [CLEAR] = REFUSED,
        [ZERO] = REFUSED,
        [FAIL] = STATION_STATE_FAULT,
    },
    [STATION_STATE_RUNNING] = {
        [IDENTIFY] = STATION_STATE_IDLE, /* another host has taken the line */
        [CONFIGURE] = REFUSED,
        [ARM] = REFUSED,
        [START] = REFUSED,
        [STOP] = STATION_STATE_IDLE,
        [CLEAR] = REFUSED,
        [ZERO] = REFUSED,
        [FAIL] = STATION_STATE_FAULT,
    },
    [STATION_STATE_FAULT] = {
        [IDENTIFY] = STATION_STATE_FAULT,
        [CONFIGURE] = REFUSED,
        [ARM] = REFUSED,
        [START] = REFUSED,
        [STOP] = STATION_STATE_FAULT,
        [CLEAR] = STATION_STATE_IDLE,
        [ZERO] = REFUSED,
        [FAIL] = STATION_STATE_FAULT,
    },
};

static void motor_off(station_core *core)
{
    core->drive = 0;
    core->session = 0;
    memset(core->slot_full, 0, sizeof core->slot_full);
}

static uint8_t move(station_core *core, event what)
{
    const uint8_t next = after[core->state][what];
    if (next == REFUSED) {
        return STATION_RESULT_WRONG_STATE;
    }
    if (next != STATION_STATE_RUNNING) {
        motor_off(core);
    }
    core->state = next;
    return STATION_RESULT_OK;
}

/* ---- sending ---- */

static void send(station_core *core, const uint8_t *body, uint16_t length, uint16_t session)
{
    if (core->transmit + length + WIRE_MARGIN > STATION_TRANSMIT_BYTES) {
        core->statistics.overruns++;
        return;
    }
    core->transmit = (uint16_t)(core->transmit
                                + station_encode(body, length, session, core->transmit_bytes + core->transmit));
}

static uint16_t standing(const station_core *core)
{
    uint16_t status = 0;
    if (core->state == STATION_STATE_RUNNING) {
        status |= STATION_STATUS_RUNNING;
    }
    if (core->state == STATION_STATE_FAULT) {
        status |= STATION_STATUS_FAULT;
    }
    if (core->rest_ticks < core->rest_ticks_need) {
        status |= STATION_STATUS_MOVING;
    }
    return status;
}

static void send_reply(station_core *core, uint8_t request, uint8_t result)
{
    uint8_t body[STATION_BODY_REPLY];
    const station_reply reply = {
        .request = request,
        .result = result,
        .state = core->state,
        .fault = core->fault,
        .status = standing(core),
        .encoder = core->encoder,
    };
    station_pack_reply(&reply, body);
    send(core, body, sizeof body, 0);
}

static void send_identity(station_core *core)
{
    uint8_t body[STATION_BODY_IDENTITY];
    station_identity identity = {
        .version = STATION_PROTOCOL_VERSION,
        .hash = STATION_PROTOCOL_HASH,
        .challenge = core->challenge,
        .boot = core->board.boot,
        .zeroings = core->zeroings,
        .clock_hz = core->board.clock_hz,
        .rate_min = core->board.rate_min,
        .rate_max = core->board.rate_max,
        .command_limit = core->board.command_limit,
        .flags = core->board.flags,
        .build = core->board.build,
        .reset = core->board.reset,
        .state = core->state,
    };
    memcpy(identity.board, core->board.name, sizeof identity.board);
    station_pack_identity(&identity, body);
    send(core, body, sizeof body, 0);
}

static void send_statistics(station_core *core)
{
    uint8_t body[STATION_BODY_STATISTICS];
    core->statistics.state = core->state;
    core->statistics.fault = core->fault;
    core->statistics.status = standing(core);
    core->statistics.encoder = core->encoder;
    station_pack_statistics(&core->statistics, body);
    send(core, body, sizeof body, 0);
}

static void send_fault(station_core *core, uint16_t index)
{
    uint8_t body[STATION_BODY_FAULT];
    const station_fault message = {.fault = core->fault, .index = index};
    station_pack_fault(&message, body);
    send(core, body, sizeof body, 0);
}

/* ---- messages from the host ---- */

static uint32_t next_random(uint32_t value)
{
    value ^= value << 13;
    value ^= value >> 17;
    value ^= value << 5;
    return value;
}

static void on_identify(station_core *core, const uint8_t *body)
{
    station_identify message;
    station_unpack_identify(body, &message);
    (void)move(core, IDENTIFY);
    core->trusted = message.version == STATION_PROTOCOL_VERSION && message.hash == STATION_PROTOCOL_HASH;
    core->configured = 0;
    core->random = next_random(core->random);
    core->challenge = core->random;
    send_identity(core);
}

static uint8_t on_configure(station_core *core, const uint8_t *body)
{
    station_configure wanted;
    station_unpack_configure(body, &wanted);
    if (after[core->state][CONFIGURE] == REFUSED) {
        return STATION_RESULT_WRONG_STATE;
    }
    if (!core->trusted) {
        return STATION_RESULT_WRONG_PROTOCOL;
    }
    const uint32_t fault_ticks = wanted.rate / (1000000u / STATION_FAULT_TIME_MAX_MS);
    const uint32_t fault_ticks_max = fault_ticks < 2u ? 2u : fault_ticks;
    if (wanted.rate < core->board.rate_min || wanted.rate > core->board.rate_max || wanted.command_limit < 0
        || wanted.command_limit > core->board.command_limit || wanted.hold_ticks > STATION_HOLD_TICKS_MAX
        || wanted.fault_ticks <= wanted.hold_ticks || wanted.fault_ticks > fault_ticks_max
        || wanted.answer_ticks < 1 || wanted.answer_ticks > STATION_ANSWER_TICKS_MAX) {
        return STATION_RESULT_OUT_OF_RANGE;
    }
    core->config = wanted;
    core->rest_ticks_need = wanted.rate / (1000000u / STATION_REST_TIME_MS);
    core->configured = 1;
    return STATION_RESULT_OK;
}

static uint8_t on_arm(station_core *core, const uint8_t *body)
{
    station_arm message;
    station_unpack_arm(body, &message);
    if (after[core->state][ARM] == REFUSED) {
        return STATION_RESULT_WRONG_STATE;
    }
    if (!core->configured) {
        return STATION_RESULT_NOT_CONFIGURED;
    }
    if (message.challenge != core->challenge) {
        return STATION_RESULT_STALE;
    }
    return move(core, ARM);
}

static uint8_t on_start(station_core *core, const uint8_t *body)
{
    station_start message;
    station_unpack_start(body, &message);
    if (after[core->state][START] == REFUSED) {
        return STATION_RESULT_WRONG_STATE;
    }
    if (message.session == 0) {
        return STATION_RESULT_OUT_OF_RANGE;
    }
    memset(&core->statistics, 0, sizeof core->statistics);
    core->configured = 0; /* the next run wants its own identify and configure */
    core->session = message.session;
    core->next_index = 0;
    core->first_ticks = core->config.answer_ticks;
    core->silent = 0;
    core->news = 0;
    core->drive = 0;
    return move(core, START);
}

static uint8_t on_zero(station_core *core)
{
    if (after[core->state][ZERO] == REFUSED) {
        return STATION_RESULT_WRONG_STATE;
    }
    if (standing(core) & STATION_STATUS_MOVING) {
        return STATION_RESULT_MOVING;
    }
    core->encoder_zero += (uint32_t)core->encoder;
    core->encoder = 0;
    core->rest_encoder = 0;
    core->zeroings++;
    return move(core, ZERO);
}

static uint8_t on_clear(station_core *core)
{
    const uint8_t result = move(core, CLEAR);
    if (result == STATION_RESULT_OK) {
        core->fault = STATION_FAULT_NONE;
    }
    return result;
}

static void on_command(station_core *core, const uint8_t *body)
{
    station_command message;
    station_unpack_command(body, &message);
    const uint16_t distance = (uint16_t)(message.index - core->next_index);
    const int32_t ahead = distance < 0x8000u ? (int32_t)distance : (int32_t)distance - 0x10000;
    if (ahead > STATION_INDEX_WINDOW || ahead < -STATION_INDEX_WINDOW) {
        core->statistics.out_of_window++;
        return;
    }
    if (ahead < 0) {
        core->statistics.late++;
        core->news |= STATION_STATUS_LATE;
        return;
    }
    if (ahead >= core->config.answer_ticks || ahead < core->first_ticks) {
        core->statistics.early++;
        core->news |= STATION_STATUS_EARLY;
        return;
    }
    const uint16_t slot = message.index % STATION_SLOTS;
    if (core->slot_full[slot]) {
        core->statistics.repeated++;
        core->news |= STATION_STATUS_REPEATED;
        return;
    }
    const int16_t limit = core->config.command_limit;
    core->slot_cut[slot] = 1;
    if (message.command > limit) {
        core->slot_command[slot] = limit;
    } else if (message.command < -limit) {
        core->slot_command[slot] = (int16_t)-limit;
    } else {
        core->slot_command[slot] = message.command;
        core->slot_cut[slot] = 0;
    }
    core->slot_full[slot] = 1;
    core->statistics.limited += core->slot_cut[slot];
    core->statistics.commands++;
}

static void on_body(station_core *core, const uint8_t *body)
{
    uint8_t result;
    switch (body[0]) {
    case STATION_CODE_IDENTIFY: on_identify(core, body); return;
    case STATION_CODE_COMMAND: on_command(core, body); return;
    case STATION_CODE_QUERY: send_statistics(core); return;
    case STATION_CODE_CONFIGURE: result = on_configure(core, body); break;
    case STATION_CODE_ARM: result = on_arm(core, body); break;
    case STATION_CODE_START: result = on_start(core, body); break;
    case STATION_CODE_STOP: result = move(core, STOP); break;
    case STATION_CODE_CLEAR: result = on_clear(core); break;
    case STATION_CODE_ZERO: result = on_zero(core); break;
    default: return; /* one of our own messages, come back on the line */
    }
    send_reply(core, body[0], result);
}

/* The body's code where the frame passes, else 0.  Frames of scope "session" pass in their session alone. */
static uint8_t check(station_core *core, uint16_t received)
{
    uint8_t *bytes = core->receive_bytes;
    const uint16_t length = station_unstuff(bytes, received);
    if (length < 3 || station_body_size(bytes[0]) + 2 != length) {
        return 0;
    }
    const uint16_t session = bytes[0] == STATION_CODE_COMMAND ? core->session : 0;
    if (bytes[0] == STATION_CODE_COMMAND && session == 0) {
        return 0;
    }
    return station_crc((uint16_t)(STATION_CRC_START ^ session), bytes, length) == 0 ? bytes[0] : 0;
}

void station_receive(station_core *core, const uint8_t *bytes, uint16_t length)
{
    for (uint16_t i = 0; i < length; i++) {
        if (bytes[i] != 0) {
            if (core->received < STATION_FRAME_BYTES) {
                core->receive_bytes[core->received++] = bytes[i];
            } else {
                core->overlong = 1;
            }
            continue;
        }
        const uint16_t received = core->received;
        const uint8_t overlong = core->overlong;
        core->received = 0;
        core->overlong = 0;
        if (received == 0) {
            continue;
        }
        if (!overlong && check(core, received)) {
            on_body(core, core->receive_bytes);
        } else {
            core->statistics.corrupt++;
            core->news |= STATION_STATUS_CORRUPT;
        }
    }
}

/* ---- the tick ---- */

/* Sets the drive of this tick; returns the status bits that say how it came about. */
static uint16_t apply_command(station_core *core)
{
    const uint16_t slot = core->next_index % STATION_SLOTS;
    if (core->slot_full[slot]) {
        core->slot_full[slot] = 0;
        core->silent = 0;
        core->drive = core->slot_command[slot];
        return core->slot_cut[slot] ? STATION_STATUS_SATURATED : 0;
    }
    if (core->first_ticks > 0) {
        return 0;
    }
    core->silent++;
    if (core->silent >= core->config.fault_ticks) {
        core->statistics.zeroed++;
        core->fault = STATION_FAULT_HOST_SILENT;
        (void)move(core, FAIL);
        return STATION_STATUS_ZEROED;
    }
    if (core->silent > core->config.hold_ticks) {
        core->statistics.zeroed++;
        core->drive = 0;
        return STATION_STATUS_ZEROED;
    }
    core->statistics.held++;
    return STATION_STATUS_HELD;
}

static void watch_rest(station_core *core)
{
    const uint32_t moved = (uint32_t)core->encoder - (uint32_t)core->rest_encoder + 1u; /* 0, 1, 2: within one count */
    if (moved > 2u) {
        core->rest_encoder = core->encoder;
        core->rest_ticks = 0;
    } else if (core->rest_ticks < core->rest_ticks_need) {
        core->rest_ticks++;
    }
}

static int32_t as_signed(uint32_t value)
{
    return value < 0x80000000u ? (int32_t)value : -(int32_t)(0xffffffffu - value) - 1;
}

void station_tick(station_core *core, const station_input *input, station_output *output)
{
    const uint16_t session = core->session;
    uint16_t status = 0;
    core->encoder = as_signed((uint32_t)input->encoder - core->encoder_zero);
    core->random ^= input->clock; /* the time at which a host asks is part of the challenge */
    if (core->random == 0) {
        core->random = 1;
    }
    watch_rest(core);
    if (input->flags & STATION_INPUT_WOKE_LATE) {
        core->statistics.woke_late++;
        status |= STATION_STATUS_WOKE_LATE;
    }
    if (core->state == STATION_STATE_RUNNING) {
        uint8_t body[STATION_BODY_SAMPLE];
        status |= apply_command(core);
        status |= (uint16_t)(standing(core) | core->news);
        core->news = 0;
        const station_sample sample = {
            .index = core->next_index,
            .clock = input->clock,
            .encoder = core->encoder,
            .accel = input->accel,
            .command = core->drive,
            .status = status,
        };
        station_pack_sample(&sample, body);
        send(core, body, sizeof body, session);
        core->statistics.samples++;
        if (core->state == STATION_STATE_FAULT) {
            send_fault(core, core->next_index);
        }
        core->next_index++;
        if (core->first_ticks > 0) {
            core->first_ticks--;
        }
    } else {
        status |= standing(core);
    }
    output->drive = core->drive;
    output->status = status;
    output->enable = core->state == STATION_STATE_RUNNING;
}

uint16_t station_transmit(station_core *core, uint8_t *bytes, uint16_t capacity)
{
    const uint16_t count = core->transmit < capacity ? core->transmit : capacity;
    memcpy(bytes, core->transmit_bytes, count);
    core->transmit = (uint16_t)(core->transmit - count);
    memmove(core->transmit_bytes, core->transmit_bytes + count, core->transmit);
    return count;
}

void station_init(station_core *core, const station_board *board, uint32_t entropy)
{
    memset(core, 0, sizeof *core);
    core->board = *board;
    core->random = entropy ? entropy : 1;
    core->config.rate = board->rate_max;
    core->config.hold_ticks = STATION_HOLD_TICKS_DEFAULT;
    core->config.fault_ticks = STATION_FAULT_TICKS_DEFAULT;
    core->config.answer_ticks = 1;
    core->rest_ticks_need = board->rate_max / (1000000u / STATION_REST_TIME_MS);
}
