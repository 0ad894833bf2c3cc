#include "core.h"

#include <string.h>

#include "frame.h"
#include "states.h"

/* ---- states ---- */

static void motor_off(station_core *core)
{
    core->drive = 0;
    memset(core->slot_full, 0, sizeof core->slot_full);
}

/* What firmware/states.toml says of an event in the present state.  Whatever leaves `running` takes the drive to
   zero.  Returns STATION_RESULT_WRONG_STATE where the cell refuses, and changes nothing then. */
static uint8_t happen(station_core *core, uint8_t event)
{
    const station_cell *cell = &station_cells[core->state][event];
    core->counts[cell->counter]++;
    if (cell->next >= STATION_STATES) {
        return STATION_RESULT_WRONG_STATE;
    }
    if (cell->next != STATION_STATE_RUNNING) {
        motor_off(core);
    }
    if (cell->fault != STATION_FAULT_NONE) {
        core->fault = cell->fault;
        core->counts[STATION_COUNT_FAULTS]++;
    }
    core->state = cell->next;
    return STATION_RESULT_OK;
}

/* ---- sending ---- */

/* Whether there was room. */
static uint8_t send(station_core *core, const uint8_t *body, uint16_t length, uint16_t session)
{
    if (core->transmit + length + STATION_FRAME_MARGIN > STATION_TRANSMIT_BYTES) {
        core->counts[STATION_COUNT_UNSENT_FRAMES]++;
        return 0;
    }
    core->transmit = (uint16_t)(core->transmit
                                + station_encode(body, length, session, core->transmit_bytes + core->transmit));
    return 1;
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
    if (core->estop) {
        status |= STATION_STATUS_ESTOP;
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
    (void)send(core, body, sizeof body, 0);
}

static void send_identity(station_core *core, uint16_t nonce)
{
    uint8_t body[STATION_BODY_IDENTITY];
    station_identity identity = {
        .version = STATION_PROTOCOL_VERSION,
        .hash = STATION_PROTOCOL_HASH,
        .nonce = nonce,
        .challenge = core->challenge,
        .boot = core->board.boot,
        .zeroings = core->zeroings,
        .clock_hz = core->board.clock_hz,
        .rate_min = core->board.rate_min,
        .rate_max = core->board.rate_max,
        .command_limit = core->board.command_limit,
        .travel_limit = core->board.travel_limit,
        .speed_limit = core->board.speed_limit,
        .stall_command = core->board.stall_command,
        .stall_time = core->board.stall_time,
        .baud_rate = core->board.baud_rate,
        .allowance = core->board.allowance,
        .flags = core->board.flags,
        .build = core->board.build,
        .reset = core->board.reset,
        .state = core->state,
    };
    memcpy(identity.board, core->board.name, sizeof identity.board);
    station_pack_identity(&identity, body);
    (void)send(core, body, sizeof body, 0);
}

static void send_statistics(station_core *core)
{
    uint8_t body[STATION_BODY_STATISTICS];
    station_statistics statistics = {
        .state = core->state,
        .fault = core->fault,
        .status = standing(core),
        .encoder = core->encoder,
    };
    station_fill_statistics(core->counts, &statistics);
    station_pack_statistics(&statistics, body);
    (void)send(core, body, sizeof body, 0);
}

static void send_fault(station_core *core, uint16_t index)
{
    uint8_t body[STATION_BODY_FAULT];
    const station_fault message = {.fault = core->fault, .index = index};
    station_pack_fault(&message, body);
    (void)send(core, body, sizeof body, 0);
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
    core->trusted = message.version == STATION_PROTOCOL_VERSION && message.hash == STATION_PROTOCOL_HASH;
    core->configured = 0;
    core->spent = 0;
    core->random = next_random(core->random);
    core->challenge = core->random;
    (void)happen(core, STATION_EVENT_IDENTIFY);
    send_identity(core, message.nonce);
}

static uint32_t ticks_of(uint32_t rate, uint32_t milliseconds)
{
    return (uint32_t)((uint64_t)rate * milliseconds / 1000000u);
}

/* Microseconds that so many bytes take, rounded up. */
static uint32_t line_time(uint32_t bytes, uint32_t baud_rate)
{
    return baud_rate == 0 ? 0 : (bytes * STATION_LINE_BITS_PER_BYTE * 1000000u + baud_rate - 1u) / baud_rate;
}

/* The line's budget: sample, command and allowance within answer_ticks periods, each frame within one. */
static uint8_t carries(const station_board *board, const station_configure *wanted)
{
    const uint32_t period = 1000000000u / wanted->rate;
    const uint32_t sample = line_time(STATION_BODY_SAMPLE + STATION_FRAME_MARGIN, board->baud_rate);
    const uint32_t command = line_time(STATION_BODY_COMMAND + STATION_FRAME_MARGIN, board->baud_rate);
    return sample <= period && command <= period
           && sample + command + board->allowance <= wanted->answer_ticks * period;
}

/* Writes the limit that holds; 0 stands for none in the board's own and for the board's own in the wanted one.
   Whether the wanted one is no looser. */
static uint8_t tighten(uint32_t own, uint32_t *wanted)
{
    if (*wanted == 0) {
        *wanted = own;
    }
    return own == 0 || *wanted <= own;
}

static uint8_t tighten_all(const station_board *board, station_configure *wanted)
{
    uint32_t travel = wanted->travel_limit;
    uint32_t speed = wanted->speed_limit;
    uint32_t command = (uint16_t)wanted->stall_command;
    uint32_t time = wanted->stall_time;
    if (wanted->command_limit < 0 || wanted->command_limit > board->command_limit || wanted->stall_command < 0
        || !tighten(board->travel_limit, &travel) || !tighten(board->speed_limit, &speed)
        || !tighten((uint16_t)board->stall_command, &command) || !tighten(board->stall_time, &time)) {
        return 0;
    }
    wanted->travel_limit = travel;
    wanted->speed_limit = (uint16_t)speed;
    wanted->stall_command = (int16_t)command;
    wanted->stall_time = (uint16_t)time;
    return (command == 0) == (time == 0); /* a level without a time watches nothing */
}

static uint8_t on_configure(station_core *core, const uint8_t *body)
{
    station_configure wanted;
    station_unpack_configure(body, &wanted);
    if (!core->trusted) {
        return STATION_RESULT_WRONG_PROTOCOL;
    }
    const uint32_t fault_ticks = ticks_of(wanted.rate, STATION_FAULT_TIME_MAX_MS);
    const uint32_t fault_ticks_max = fault_ticks < 2u ? 2u : fault_ticks;
    if (wanted.rate < core->board.rate_min || wanted.rate > core->board.rate_max
        || wanted.hold_ticks > STATION_HOLD_TICKS_MAX
        || wanted.fault_ticks <= wanted.hold_ticks || wanted.fault_ticks > fault_ticks_max
        || wanted.answer_ticks < 1 || wanted.answer_ticks > STATION_ANSWER_TICKS_MAX
        || !tighten_all(&core->board, &wanted)) {
        return STATION_RESULT_OUT_OF_RANGE;
    }
    if (!carries(&core->board, &wanted)) {
        return STATION_RESULT_LINE_TOO_SLOW;
    }
    core->config = wanted;
    core->rest_ticks_need = ticks_of(wanted.rate, STATION_REST_TIME_MS);
    core->stall_ticks_need = ticks_of(wanted.rate, wanted.stall_time);
    core->configured = 1;
    return STATION_RESULT_OK;
}

static uint8_t on_arm(station_core *core, const uint8_t *body)
{
    station_arm message;
    station_unpack_arm(body, &message);
    if (!core->configured) {
        return STATION_RESULT_NOT_CONFIGURED;
    }
    if (message.challenge != core->challenge) {
        return STATION_RESULT_STALE;
    }
    if (core->state == STATION_STATE_ARMED) { /* asked again, the answer was lost: no more time for that */
        return STATION_RESULT_OK;
    }
    if (core->spent) {
        return STATION_RESULT_STALE;
    }
    core->spent = 1;
    core->armed_ticks = ticks_of(core->config.rate, STATION_ARMED_TIME_MS);
    return STATION_RESULT_OK;
}

static uint8_t on_start(station_core *core, const uint8_t *body)
{
    station_start message;
    station_unpack_start(body, &message);
    if (message.session == 0) {
        return STATION_RESULT_OUT_OF_RANGE;
    }
    if (message.challenge != core->challenge) {
        return STATION_RESULT_STALE;
    }
    memset(core->counts, 0, sizeof core->counts);
    core->configured = 0; /* the next run wants its own identify and configure */
    core->session = message.session;
    core->next_index = 0;
    core->first_ticks = core->config.answer_ticks;
    core->begun = 0;
    core->silent = 0;
    core->news = 0;
    return STATION_RESULT_OK;
}

static uint8_t on_zero(station_core *core)
{
    if (standing(core) & STATION_STATUS_MOVING) {
        return STATION_RESULT_MOVING;
    }
    core->encoder_zero += (uint32_t)core->encoder;
    core->encoder = 0;
    core->rest_encoder = 0;
    core->past_known = 0;
    core->zeroings++;
    return STATION_RESULT_OK;
}

static uint8_t on_clear(station_core *core)
{
    if (core->estop) {
        return STATION_RESULT_ESTOP_OPEN;
    }
    core->fault = STATION_FAULT_NONE;
    return STATION_RESULT_OK;
}

/* Latches a command for its tick; returns the event that it is. */
static uint8_t latch(station_core *core, const uint8_t *body)
{
    station_command message;
    station_unpack_command(body, &message);
    const uint16_t distance = (uint16_t)(message.index - core->next_index);
    const int32_t ahead = distance < 0x8000u ? (int32_t)distance : (int32_t)distance - 0x10000;
    if (ahead > STATION_INDEX_WINDOW || ahead < -STATION_INDEX_WINDOW) {
        return STATION_EVENT_OUT_OF_WINDOW;
    }
    if (ahead < 0) {
        core->news |= STATION_STATUS_LATE;
        return STATION_EVENT_LATE;
    }
    if (ahead >= core->config.answer_ticks || ahead < core->first_ticks) {
        core->news |= STATION_STATUS_EARLY;
        return STATION_EVENT_EARLY;
    }
    const uint16_t slot = message.index % STATION_SLOTS;
    if (core->slot_full[slot]) {
        core->news |= STATION_STATUS_REPEATED;
        return STATION_EVENT_REPEATED;
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
    core->counts[STATION_COUNT_LIMITED] += core->slot_cut[slot];
    return STATION_EVENT_COMMAND;
}

/* What a request comes to in a state that does not refuse it. */
static uint8_t on_request(station_core *core, const uint8_t *body)
{
    switch (body[0]) {
    case STATION_CODE_CONFIGURE: return on_configure(core, body);
    case STATION_CODE_ARM: return on_arm(core, body);
    case STATION_CODE_START: return on_start(core, body);
    case STATION_CODE_CLEAR: return on_clear(core);
    case STATION_CODE_ZERO: return on_zero(core);
    default: return STATION_RESULT_OK; /* stop */
    }
}

static void on_body(station_core *core, const uint8_t *body)
{
    if (body[0] > STATION_EVENT_QUERY + 1) {
        return; /* one of our own messages, come back on the line */
    }
    const uint8_t event = (uint8_t)(body[0] - 1u); /* the host's messages come first among the events */
    uint8_t result;
    switch (event) {
    case STATION_EVENT_IDENTIFY: on_identify(core, body); return;
    case STATION_EVENT_COMMAND: (void)happen(core, latch(core, body)); return;
    case STATION_EVENT_QUERY: send_statistics(core); return;
    default: break;
    }
    if (station_cells[core->state][event].next == STATION_REFUSED) {
        result = happen(core, event);
    } else {
        result = on_request(core, body);
        if (result == STATION_RESULT_OK) {
            result = happen(core, event);
        } else {
            core->counts[STATION_COUNT_REFUSED]++;
        }
    }
    send_reply(core, body[0], result);
}

/* The body's code where the frame passes, else 0.  Frames of scope "session" pass in their session alone. */
static uint8_t check(station_core *core, uint16_t received)
{
    uint8_t *bytes = core->receive_bytes;
    const uint8_t code = received > 1 ? bytes[1] : 0;
    if (code == STATION_CODE_COMMAND && station_cells[core->state][STATION_EVENT_COMMAND].next == STATION_FOREIGN) {
        return 0;
    }
    const uint16_t length = station_decode(bytes, received, code == STATION_CODE_COMMAND ? core->session : 0);
    return length > 0 && station_body_size(bytes[0]) == length ? bytes[0] : 0;
}

void station_receive(station_core *core, const uint8_t *bytes, uint16_t length)
{
    for (uint16_t i = 0; i < length; i++) {
        if (bytes[i] != 0) {
            if (core->received < STATION_FRAME_BYTES) { /* a frame cut off here is longer than any, and no message */
                core->receive_bytes[core->received++] = bytes[i];
            }
            continue;
        }
        const uint16_t received = core->received;
        core->received = 0;
        if (received == 0) {
            continue;
        }
        if (check(core, received)) {
            on_body(core, core->receive_bytes);
        } else {
            (void)happen(core, STATION_EVENT_CORRUPT);
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
        (void)happen(core, STATION_EVENT_HOST_SILENT);
        return STATION_STATUS_ZEROED;
    }
    if (core->silent > core->config.hold_ticks) {
        (void)happen(core, STATION_EVENT_ZEROED);
        core->drive = 0;
        return STATION_STATUS_ZEROED;
    }
    (void)happen(core, STATION_EVENT_HELD);
    return STATION_STATUS_HELD;
}

static uint32_t distance_between(int32_t a, int32_t b)
{
    const uint32_t distance = (uint32_t)a - (uint32_t)b;
    return distance < 0x80000000u ? distance : 0u - distance;
}

static void watch_rest(station_core *core)
{
    if (distance_between(core->encoder, core->rest_encoder) > 1u) {
        core->rest_encoder = core->encoder;
        core->rest_ticks = 0;
    } else if (core->rest_ticks < core->rest_ticks_need) {
        core->rest_ticks++;
    }
}

/* Counts that the encoder has moved within the last speed_ticks ticks, or since the first of them. */
static uint32_t watch_speed(station_core *core)
{
    if (!core->past_known) {
        core->past_known = 1;
        for (uint8_t i = 0; i < STATION_SPEED_TICKS; i++) {
            core->past[i] = core->encoder;
        }
    }
    const uint32_t moved = distance_between(core->encoder, core->past[core->past_at]);
    core->past[core->past_at] = core->encoder;
    core->past_at = (uint8_t)((core->past_at + 1u) % STATION_SPEED_TICKS);
    return moved;
}

/* Ticks, this one included, that a drive above the stall level has not moved the encoder. */
static uint32_t watch_stall(station_core *core)
{
    const int16_t level = core->config.stall_command;
    const uint8_t driven = core->drive > level || core->drive < -level;
    if (!driven || distance_between(core->encoder, core->stall_encoder) > STATION_STALL_COUNTS) {
        core->stall_encoder = core->encoder;
        core->stall_ticks = 0;
    } else {
        core->stall_ticks++;
    }
    return core->stall_ticks;
}

/* The limits of motion, on what the last tick's drive has led to. */
static void watch_motion(station_core *core, uint32_t speed)
{
    const station_configure *limits = &core->config;
    if (!core->begun) {
        core->begun = 1;
        core->origin = core->encoder;
        core->stall_encoder = core->encoder;
        core->stall_ticks = 0;
    }
    const uint32_t stalled = watch_stall(core);
    if (limits->travel_limit > 0 && distance_between(core->encoder, core->origin) > limits->travel_limit) {
        (void)happen(core, STATION_EVENT_TRAVEL);
    }
    if (limits->speed_limit > 0 && speed > limits->speed_limit) {
        (void)happen(core, STATION_EVENT_SPEED);
    }
    if (limits->stall_command > 0 && stalled > core->stall_ticks_need) {
        (void)happen(core, STATION_EVENT_STALLED);
    }
}

/* What the board says of this tick; returns its status bits. */
static uint16_t watch_board(station_core *core, uint16_t flags)
{
    uint16_t status = 0;
    core->estop = (flags & STATION_INPUT_ESTOP) != 0;
    if (core->estop) {
        (void)happen(core, STATION_EVENT_ESTOP);
    }
    if (flags & STATION_INPUT_OVERRUN) {
        (void)happen(core, STATION_EVENT_OVERRUN);
        status |= STATION_STATUS_OVERRUN;
    }
    if (flags & STATION_INPUT_HOST_GONE) {
        core->configured = 0;
        (void)happen(core, STATION_EVENT_HOST_GONE);
    }
    if (flags & STATION_INPUT_WOKE_LATE) {
        (void)happen(core, STATION_EVENT_WOKE_LATE);
        status |= STATION_STATUS_WOKE_LATE;
    }
    return status;
}

static int32_t as_signed(uint32_t value)
{
    return value < 0x80000000u ? (int32_t)value : -(int32_t)(0xffffffffu - value) - 1;
}

static void send_sample(station_core *core, const station_input *input, uint16_t status, uint16_t session)
{
    uint8_t body[STATION_BODY_SAMPLE];
    const station_sample sample = {
        .index = core->next_index,
        .clock = input->clock,
        .encoder = core->encoder,
        .accel = input->accel,
        .command = core->drive,
        .status = status,
    };
    station_pack_sample(&sample, body);
    core->counts[send(core, body, sizeof body, session) ? STATION_COUNT_SAMPLES : STATION_COUNT_UNSENT_SAMPLES]++;
}

void station_present(const station_core *core, station_output *output)
{
    output->drive = core->drive;
    output->enable = core->state == STATION_STATE_RUNNING;
}

void station_tick(station_core *core, const station_input *input, station_output *output)
{
    const uint16_t session = core->session;
    const uint8_t before = core->state;
    core->encoder = as_signed((uint32_t)input->encoder - core->encoder_zero);
    core->random ^= input->clock; /* the time at which a host asks is part of the challenge */
    if (core->random == 0) {
        core->random = 1;
    }
    watch_rest(core);
    const uint32_t speed = watch_speed(core);
    if (core->state == STATION_STATE_ARMED && core->armed_ticks-- == 0) {
        (void)happen(core, STATION_EVENT_EXPIRE);
    }
    uint16_t status = watch_board(core, input->flags);
    if (core->state == STATION_STATE_RUNNING) {
        watch_motion(core, speed);
    }
    if (core->state == STATION_STATE_RUNNING) {
        status |= apply_command(core);
    }
    status |= standing(core);
    if (before == STATION_STATE_RUNNING) {
        status |= core->news;
        core->news = 0;
        send_sample(core, input, status, session);
    }
    if (core->state == STATION_STATE_FAULT && before != STATION_STATE_FAULT) {
        send_fault(core, core->next_index);
    }
    if (before == STATION_STATE_RUNNING) {
        core->next_index++;
        if (core->first_ticks > 0) {
            core->first_ticks--;
        }
    }
    output->status = status;
    station_present(core, output);
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
    core->rest_ticks_need = ticks_of(board->rate_max, STATION_REST_TIME_MS);
}
