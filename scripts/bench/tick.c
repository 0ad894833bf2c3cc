/* Instructions of the tick's body and of each message, in each state, on the emulated mps2_an385 under -icount shift=10:
   each instruction then takes 1024 ns, that is 25.6 counts of the 25 MHz timer.  Output by semihosting. */

#include <string.h>

#include "board.h"
#include "frame.h"

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))
#define CLOCK_LOAD REGISTER(0x40002000)
#define CLOCK_VALUE REGISTER(0x40002004)
#define CLOCK_CTRL REGISTER(0x40002008)

enum { RUN_TICKS = 20 };

static station_input sensors;

/* ---- the least board ---- */

uint32_t board_start(station_board *about) { (void)about; return 1; }
void board_rate(uint32_t rate) { (void)rate; }
void board_read(station_input *input) { *input = sensors; }
void board_drive(const station_output *output) { *(volatile int16_t *)&sensors.accel = output->drive; }
uint32_t board_mask(void) { return 0; }
void board_unmask(uint32_t before) { (void)before; }
uint16_t board_receive(uint8_t *bytes, uint16_t room) { (void)bytes; (void)room; return 0; }
uint16_t board_room(void) { return 0; }
void board_send(const uint8_t *bytes, uint16_t count) { (void)bytes; (void)count; }
void board_feed(void) {}
void board_rest(void) {}

/* ---- words ---- */

static void say(const char *text)
{
    register uint32_t operation __asm("r0") = 4; /* SYS_WRITE0 */
    register const char *argument __asm("r1") = text;
    __asm volatile("bkpt 0xab" : "+r"(operation) : "r"(argument) : "memory");
}

static void say_number(const char *words, const char *more, uint32_t value)
{
    char digits[12];
    int at = sizeof digits - 1;
    digits[at] = 0;
    do {
        digits[--at] = (char)('0' + value % 10);
        value /= 10;
    } while (value);
    say(words);
    say(" | ");
    say(more);
    say(" | ");
    say(digits + at);
    say("\n");
}

static uint32_t overhead;

static uint32_t instructions(uint32_t from)
{
    const uint32_t counts = from - CLOCK_VALUE;
    return (uint32_t)((uint64_t)counts * 10u / 256u) - overhead;
}

/* ---- what is measured ---- */

static station_core *const core = &station_board_core;
static uint8_t line[STATION_TRANSMIT_BYTES];

static void give(const uint8_t *body, uint16_t length, uint16_t session)
{
    uint8_t wire[STATION_FRAME_BYTES];
    station_receive(core, wire, station_encode(body, length, session, wire));
    (void)station_transmit(core, line, sizeof line);
}

static void bring(uint8_t state)
{
    static const station_board board = {.boot = 1, .clock_hz = 1000000, .rate_min = 100000, .rate_max = 500000,
                                        .command_limit = 200, .travel_limit = 5000, .speed_limit = 400,
                                        .stall_command = 100, .stall_time = 1000, .baud_rate = 921600,
                                        .allowance = 500, .name = "tick"};
    uint8_t body[STATION_FRAME_BYTES];
    station_init(core, &board, 12345);
    memset(&sensors, 0, sizeof sensors);
    if (state == STATION_STATE_IDLE) {
        return;
    }
    const station_identify identify = {.version = STATION_PROTOCOL_VERSION, .hash = STATION_PROTOCOL_HASH};
    const station_configure configure = {.rate = 500000, .command_limit = 200, .hold_ticks = 1, .fault_ticks = 10,
                                         .answer_ticks = 1};
    station_pack_identify(&identify, body);
    give(body, STATION_BODY_IDENTIFY, 0);
    station_pack_configure(&configure, body);
    give(body, STATION_BODY_CONFIGURE, 0);
    const station_arm arm = {.challenge = core->challenge};
    station_pack_arm(&arm, body);
    give(body, STATION_BODY_ARM, 0);
    if (state == STATION_STATE_ARMED) {
        return;
    }
    const station_start start = {.session = 4711, .challenge = core->challenge};
    station_pack_start(&start, body);
    give(body, STATION_BODY_START, 0);
    for (uint32_t i = 0; i < RUN_TICKS; i++) {
        const station_command command = {.index = core->next_index, .command = 150};
        station_pack_command(&command, body);
        give(body, STATION_BODY_COMMAND, 4711);
        sensors.clock += 2000;
        sensors.encoder += 7;
        station_board_tick();
        (void)station_transmit(core, line, sizeof line);
    }
    if (state == STATION_STATE_FAULT) {
        sensors.flags = STATION_INPUT_OVERRUN;
        station_board_tick();
        sensors.flags = 0;
        (void)station_transmit(core, line, sizeof line);
    }
}

static const char *const states[] = {"idle", "armed", "running", "fault"};

static void tick_of(uint8_t state, const char *words, uint16_t flags, int32_t jump, uint8_t with_command)
{
    uint8_t body[STATION_BODY_COMMAND];
    bring(state);
    if (with_command) {
        const station_command command = {.index = core->next_index, .command = 30000};
        station_pack_command(&command, body);
        give(body, sizeof body, 4711);
    }
    sensors.flags = flags;
    sensors.encoder += jump;
    sensors.clock += 0x01010101;
    const uint32_t from = CLOCK_VALUE;
    station_board_tick();
    say_number(states[state], words, instructions(from));
}

static void message_in(uint8_t state, uint8_t code, const char *words)
{
    uint8_t body[STATION_FRAME_BYTES] = {0}, wire[STATION_FRAME_BYTES];
    bring(state);
    body[0] = code;
    const station_identify identify = {.version = STATION_PROTOCOL_VERSION, .hash = STATION_PROTOCOL_HASH};
    const station_configure configure = {.rate = 500000, .command_limit = 200, .hold_ticks = 1, .fault_ticks = 10,
                                         .answer_ticks = 1};
    const station_arm arm = {.challenge = core->challenge};
    const station_start start = {.session = 7, .challenge = core->challenge};
    const station_command command = {.index = core->next_index, .command = 30000};
    switch (code) {
    case STATION_CODE_IDENTIFY: station_pack_identify(&identify, body); break;
    case STATION_CODE_CONFIGURE: core->trusted = 1; station_pack_configure(&configure, body); break;
    case STATION_CODE_ARM: station_pack_arm(&arm, body); break;
    case STATION_CODE_START: station_pack_start(&start, body); break;
    case STATION_CODE_COMMAND: station_pack_command(&command, body); break;
    default: break;
    }
    const uint16_t size = station_encode(body, station_body_size(code), code == STATION_CODE_COMMAND ? 4711 : 0, wire);
    const uint32_t from = CLOCK_VALUE;
    station_receive(core, wire, size);
    say_number(states[state], words, instructions(from));
}

int main(void)
{
    static const char *const names[] = {"identify", "configure", "arm", "start", "command", "stop", "clear", "zero",
                                        "query"};
    CLOCK_LOAD = 0xffffffffu;
    CLOCK_CTRL = 0x82;
    const uint32_t from = CLOCK_VALUE;
    overhead = instructions(from);
    say("ticks\n");
    for (uint8_t state = 0; state < STATION_STATES; state++) {
        tick_of(state, "tick", 0, 0, 0);
        tick_of(state, "tick, e-stop opens", STATION_INPUT_ESTOP, 0, 0);
    }
    tick_of(STATION_STATE_RUNNING, "tick with its command", 0, 3, 1);
    tick_of(STATION_STATE_RUNNING, "tick, travel and speed", 0, 100000, 1);
    tick_of(STATION_STATE_RUNNING, "tick, all that a board can say", 0x0f, 100000, 1);
    say("messages\n");
    for (uint8_t state = 0; state < STATION_STATES; state++) {
        for (uint8_t code = 1; code <= STATION_CODE_QUERY; code++) {
            message_in(state, code, names[code - 1]);
        }
    }
    register uint32_t operation __asm("r0") = 0x18; /* SYS_EXIT */
    register uint32_t reason __asm("r1") = 0x20026;
    __asm volatile("bkpt 0xab" ::"r"(operation), "r"(reason));
    for (;;) {
    }
}

extern uint32_t data_begin, data_end, data_load, bss_begin, bss_end, stack_top;

void start(void);
void start(void)
{
    const uint32_t *from = &data_load;
    for (uint32_t *to = &data_begin; to != &data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = &bss_begin; to != &bss_end; to++) {
        *to = 0;
    }
    (void)main();
}

static void trap(void)
{
    say("trap\n");
    for (;;) {
    }
}

typedef void (*handler)(void);
extern const handler vectors[];
__attribute__((section(".vectors"), used)) const handler vectors[16] = {
    (handler)(uintptr_t)&stack_top, start, trap, trap, trap, trap, trap, 0, 0, 0, 0, trap, trap, 0, trap, trap};
