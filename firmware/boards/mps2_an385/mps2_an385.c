/* Arm MPS2 with the image AN385 (Cortex-M3, 25 MHz), as qemu-system-arm -M mps2-an385 emulates it.

   UART0 is the host's line.  UART1 goes to the plant model in place of a rig's wires, in packets:
     plant to board  'T' encoder (i32) accelerometer (i16) flags (low half: STATION_INPUT_..., high half: epoch)
                     'I' stop the tick's interrupt, 'M' let the main loop hang: tests of the watchdog
     board to plant  'D' drive (i16) flags: at each tick
                     'S' the same, in place of a tick: the 'T' was of an older epoch; send another one
                     'N' the same, when something has changed between ticks
                     'B' cause of the reset (u16) flags: after each reset
                     flags: 1 enabled, 2 running, 4 the coming tick is the session's first, 8 the coming tick has its
                     command or can have none; high half: epoch, the number of sessions begun, modulo 16
   Two tick sources, one interrupt routine: TIMER0 (paced), or the plant's 'T' (lockstep), as the page of settings says
   that the machine's start puts into memory.

   Registers: Arm DAI 0385D (memory map, interrupts), Arm DDI 0479C (CMSDK timers, UART, watchdog). */

#include "board.h"
#include "ring.h"

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))

/* ---- registers ---- */

#define TIMER0_CTRL REGISTER(0x40000000)
#define TIMER0_VALUE REGISTER(0x40000004)
#define TIMER0_RELOAD REGISTER(0x40000008)
#define TIMER0_CLEAR REGISTER(0x4000000c)
#define CLOCK_LOAD REGISTER(0x40002000) /* dual timer, first half: free-running clock */
#define CLOCK_VALUE REGISTER(0x40002004)
#define CLOCK_CTRL REGISTER(0x40002008)
#define WATCHDOG_LOAD REGISTER(0x40008000)
#define WATCHDOG_CTRL REGISTER(0x40008008)
#define WATCHDOG_CLEAR REGISTER(0x4000800c)
#define WATCHDOG_LOCK REGISTER(0x40008c00)
#define NVIC_ENABLE REGISTER(0xe000e100)
#define NVIC_PEND REGISTER(0xe000e200)
#define NVIC_PRIORITY(irq) (*(volatile uint8_t *)(uintptr_t)(0xe000e400 + (irq)))
#define AIRCR REGISTER(0xe000ed0c)
#define UART(n) ((volatile uart *)(uintptr_t)(0x40004000 + 0x1000 * (n)))
#define SETTINGS ((const settings *)(uintptr_t)0x00010000)

typedef struct {
    uint32_t data, state, control, status, divider;
} uart;

typedef struct { /* written by station/device/emulator.py */
    uint32_t magic;
    uint32_t lockstep;
    uint32_t entropy;
    uint32_t strict; /* a missed tick is a fault; else, the host machine being to blame, it is told as woken late */
    station_board board;
} settings;

enum {
    CLOCK_HZ = 25000000,
    FREE_HZ = CLOCK_HZ / 16,
    MAGIC = 0x53544131,
    KEPT = 0x4b455054,
    WATCHDOG_MS = 100,
    WATCHDOG_KEY = 0x1acce551,
    RX0 = 0, TX0 = 1, RX1 = 2, TX1 = 3, TICK = 8, /* interrupts */
    PRIORITY_LINE = 0x00,
    PRIORITY_TICK = 0x40,
    TX_ON = 1, RX_ON = 2, TX_INTERRUPT = 4, RX_INTERRUPT = 8, /* of a UART's control */
    FULL = 1,                                                 /* of its state */
    ENABLED = 1, RUNNING = 2, BEGINNING = 4, ANSWERED = 8,    /* flags to the plant */
    TICK_BYTES = 8
};

static ring host_in, host_out, plant_out;
static volatile uint32_t interrupts, interrupts_seen;
static volatile uint8_t stuck;
static station_input reading;
static uint8_t reading_fresh, reading_epoch, epoch, announced, last_flags;
static int16_t last_drive;
static uint8_t packet[TICK_BYTES], packet_bytes;
static uint32_t reload, lockstep_clock, last_clock;
static uint8_t clock_known;

/* What a reset leaves alone. */
static struct {
    uint32_t magic, resets;
    uint32_t cause;
} kept __attribute__((section(".kept")));

/* ---- rings and UARTs ---- */

/* Sends what has room; called with interrupts off or from the line's interrupt. */
static void drain(volatile uart *u, ring *r)
{
    while (ring_used(r) > 0 && !(u->state & FULL)) {
        u->data = ring_take(r);
    }
    u->control = TX_ON | RX_ON | RX_INTERRUPT | (ring_used(r) > 0 ? (uint32_t)TX_INTERRUPT : 0u);
}

static uint32_t lock(void)
{
    uint32_t before;
    __asm volatile("mrs %0, primask\n cpsid i" : "=r"(before)::"memory");
    return before;
}

static void unlock(uint32_t before) { __asm volatile("msr primask, %0" ::"r"(before) : "memory"); }

/* ---- the plant's wires ---- */

static uint8_t flags_now(void)
{
    const station_core *core = &station_board_core;
    uint8_t flags = (uint8_t)(epoch << 4);
    if (core->state == STATION_STATE_RUNNING) {
        flags |= ENABLED | RUNNING;
        if (!core->begun) {
            flags |= BEGINNING;
        }
        if (core->first_ticks > 0 || core->slot_full[core->next_index % STATION_SLOTS]) {
            flags |= ANSWERED;
        }
    }
    return flags;
}

static void tell(uint8_t letter, uint16_t value, uint8_t flags)
{
    const uint32_t before = lock();
    ring_put(&plant_out, letter);
    ring_put(&plant_out, (uint8_t)(value & 0xff));
    ring_put(&plant_out, (uint8_t)(value >> 8));
    ring_put(&plant_out, flags);
    drain(UART(1), &plant_out);
    unlock(before);
}

static void take_packet(void)
{
    reading.encoder = (int32_t)((uint32_t)packet[1] | (uint32_t)packet[2] << 8 | (uint32_t)packet[3] << 16
                                | (uint32_t)packet[4] << 24);
    reading.accel = (int16_t)(uint16_t)(packet[5] | packet[6] << 8);
    reading.flags = packet[7] & 0x0f;
    reading_fresh = 1;
    reading_epoch = packet[7] >> 4;
    if (SETTINGS->lockstep) {
        NVIC_PEND = 1u << TICK;
    }
}

static void plant_byte(uint8_t byte)
{
    if (packet_bytes == 0 && byte != 'T') {
        if (byte == 'I') {
            TIMER0_CTRL = 0;
        } else if (byte == 'M') {
            stuck = 1;
        }
        return;
    }
    packet[packet_bytes++] = byte;
    if (packet_bytes == TICK_BYTES) {
        packet_bytes = 0;
        take_packet();
    }
}

/* ---- interrupts ---- */

static void line_host(void)
{
    interrupts++;
    UART(0)->status = 3;
    while (UART(0)->state & 2) {
        ring_put(&host_in, (uint8_t)UART(0)->data);
    }
    drain(UART(0), &host_out);
}

static void line_plant(void)
{
    interrupts++;
    UART(1)->status = 3;
    while (UART(1)->state & 2) {
        plant_byte((uint8_t)UART(1)->data);
    }
    drain(UART(1), &plant_out);
}

static void tick(void)
{
    interrupts++;
    TIMER0_CLEAR = 1;
    if (SETTINGS->lockstep && reading_epoch != epoch) {
        tell('S', (uint16_t)last_drive, flags_now());
    } else {
        station_board_tick();
    }
}

/* The watchdog's first warning is the last: drive off, and a reset. */
static void watchdog(void)
{
    kept.cause = STATION_RESET_WATCHDOG;
    AIRCR = 0x05fa0004;
    for (;;) {
    }
}

static void trap(void)
{
    kept.cause = STATION_RESET_SOFTWARE;
    AIRCR = 0x05fa0004;
    for (;;) {
    }
}

/* ---- board.h ---- */

uint32_t board_start(station_board *about)
{
    if (kept.magic != KEPT) {
        kept.magic = KEPT;
        kept.resets = 0;
        kept.cause = STATION_RESET_POWER;
    }
    const settings *given = SETTINGS;
    if (given->magic == MAGIC) {
        *about = given->board;
    }
    about->reset = (uint8_t)kept.cause;
    about->boot ^= kept.resets * 0x9e3779b9u;
    about->clock_hz = given->lockstep ? 1000000u : (uint32_t)FREE_HZ;
    kept.cause = STATION_RESET_PIN; /* the next one, unless somebody says better */
    kept.resets++;
    CLOCK_LOAD = 0xffffffffu;
    CLOCK_CTRL = 0x86; /* enabled, 32 bits, clock / 16 */
    NVIC_PRIORITY(TICK) = PRIORITY_TICK;
    for (uint32_t irq = RX0; irq <= TX1; irq++) {
        NVIC_PRIORITY(irq) = PRIORITY_LINE;
    }
    for (uint32_t n = 0; n < 2; n++) {
        UART(n)->divider = 16;
        UART(n)->control = TX_ON | RX_ON | RX_INTERRUPT;
    }
    tell('B', about->reset, 0);
    NVIC_ENABLE = 1u << RX0 | 1u << TX0 | 1u << RX1 | 1u << TX1 | 1u << TICK;
    if (!given->lockstep) {
        WATCHDOG_LOCK = WATCHDOG_KEY;
        WATCHDOG_LOAD = CLOCK_HZ / 1000 * WATCHDOG_MS;
        WATCHDOG_CTRL = 1; /* the interrupt (NMI); it resets the chip itself */
    }
    return given->entropy ^ kept.resets * 0x85ebca6bu;
}

void board_rate(uint32_t rate)
{
    if (SETTINGS->lockstep) {
        return;
    }
    reload = (uint32_t)((uint64_t)CLOCK_HZ * 1000u / rate) - 1u;
    clock_known = 0;
    TIMER0_CTRL = 0;
    TIMER0_VALUE = reload;
    TIMER0_RELOAD = reload;
    TIMER0_CTRL = 9; /* enabled, with its interrupt */
}

/* Late: the timer has counted on for more than late_wake_us since it struck, or whole ticks are missing. */
static uint16_t lateness(uint32_t clock)
{
    const uint32_t since = reload - TIMER0_VALUE;
    const uint32_t between = clock - last_clock;
    const uint8_t missed = clock_known && between > (reload + 1u) / 16u * 3u / 2u;
    last_clock = clock;
    clock_known = 1;
    if (missed && SETTINGS->strict) {
        return STATION_INPUT_OVERRUN;
    }
    return missed || since > CLOCK_HZ / 1000000u * STATION_LATE_WAKE_US ? STATION_INPUT_WOKE_LATE : 0;
}

void board_read(station_input *input)
{
    const uint32_t before = lock();
    *input = reading;
    const uint8_t fresh = reading_fresh;
    reading_fresh = 0;
    unlock(before);
    if (SETTINGS->lockstep) {
        input->clock = lockstep_clock;
        lockstep_clock += 1000000000u / station_board_core.config.rate;
    } else {
        input->clock = ~CLOCK_VALUE;
        input->flags |= lateness(input->clock);
        if (!fresh && station_board_core.begun) {
            input->flags |= STATION_INPUT_WOKE_LATE; /* the plant model has not come up with this tick's reading */
        }
    }
}

static uint8_t in_tick(void)
{
    uint32_t exception;
    __asm volatile("mrs %0, ipsr" : "=r"(exception));
    return exception == 16 + TICK;
}

void board_drive(const station_output *output)
{
    const station_core *core = &station_board_core;
    if (core->state != STATION_STATE_RUNNING || core->begun) {
        announced = 0;
    } else if (!announced) {
        announced = 1;
        epoch = (epoch + 1) & 0x0f;
    }
    const uint8_t flags = flags_now();
    const uint8_t ticking = in_tick();
    if (ticking || output->drive != last_drive || flags != last_flags) {
        last_drive = output->drive;
        last_flags = flags;
        tell(ticking ? 'D' : 'N', (uint16_t)output->drive, flags);
    }
}

uint32_t board_mask(void)
{
    uint32_t before;
    __asm volatile("mrs %0, basepri\n msr basepri, %1" : "=&r"(before) : "r"((uint32_t)PRIORITY_TICK) : "memory");
    return before;
}

void board_unmask(uint32_t before) { __asm volatile("msr basepri, %0" ::"r"(before) : "memory"); }

uint16_t board_receive(uint8_t *bytes, uint16_t room)
{
    uint16_t count = 0;
    while (stuck) {
    }
    interrupts_seen = interrupts;
    while (count < room && ring_used(&host_in) > 0) {
        bytes[count++] = ring_take(&host_in);
    }
    return count;
}

uint16_t board_room(void) { return ring_room(&host_out); }

void board_send(const uint8_t *bytes, uint16_t count)
{
    const uint32_t before = lock();
    for (uint16_t i = 0; i < count; i++) {
        ring_put(&host_out, bytes[i]);
    }
    drain(UART(0), &host_out);
    unlock(before);
}

void board_feed(void) { WATCHDOG_CLEAR = 1; }

void board_rest(void)
{
    const uint32_t before = lock();
    if (interrupts == interrupts_seen) {
        __asm volatile("wfi");
    }
    unlock(before);
}

/* ---- reset ---- */

extern uint32_t data_begin, data_end, data_load, bss_begin, bss_end, stack_top;
extern int main(void);

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

typedef void (*handler)(void);

extern const handler vectors[];
__attribute__((section(".vectors"), used)) const handler vectors[] = {
    (handler)(uintptr_t)&stack_top, start, watchdog, trap, trap, trap, trap, 0, 0, 0, 0, trap, trap, 0, trap, trap,
    line_host, line_host, line_plant, line_plant, trap, trap, trap, trap, tick,
};
