/* Arduino Due (SAM3X8E, Cortex-M3, 84 MHz), by its registers.  Compiled against declarations of the device header;
   never run on a board: see README.md for pins, build and what to check first.

   TC0 counts the encoder, TC1 ticks, TC2 is the clock.  Data sheet: Atmel 11057C. */

#include "limits.h"
#include "sam.h"

#include "board.h"
#include "ring.h"

enum {
    MCK = 84000000,
    TIMER_HZ = MCK / 2,
    PWM_PERIOD = 4200, /* 20 kHz */
    PWM_CHANNEL = 5,   /* pin 8, PC22 */
    ADC_CHANNEL = 7,   /* pin A0, PA16 */
    ADC_MIDDLE = 2048,
    WATCHDOG_TICKS = 13, /* of 32768 / 128 Hz: 50.8 ms */
    ALLOWANCE_US = 2000, /* the programming port is a USB adapter */
    PRIORITY_LINE = 0,
    PRIORITY_TICK = 4
};

#define ENCODER_PINS (1u << 25 | 1u << 27) /* PB25, PB27: pins 2 and 13 */
#define PWM_PIN (1u << 22)                 /* PC22: pin 8 */
#define FORWARD_PIN (1u << 24)             /* PC24: pin 6 */
#define ENABLE_PIN (1u << 25)              /* PC25: pin 5 */
#define ESTOP_PIN (1u << 28)               /* PC28: pin 3 */
#define UART_PINS (1u << 8 | 1u << 9)      /* PA8, PA9: pins 0 and 1, the programming port */

static ring line_in, line_out;
static uint32_t reload, last_clock;
static uint8_t clock_known;

/* ---- the drive ---- */

void board_drive(const station_output *output)
{
    const int32_t drive = output->enable ? output->drive : 0;
    const uint32_t size = (uint32_t)(drive < 0 ? -drive : drive);
    if (!output->enable) {
        PIOC->PIO_CODR = ENABLE_PIN;
    }
    if (drive >= 0) {
        PIOC->PIO_SODR = FORWARD_PIN;
    } else {
        PIOC->PIO_CODR = FORWARD_PIN;
    }
    PWM->PWM_CH_NUM[PWM_CHANNEL].PWM_CDTYUPD = size * PWM_PERIOD / RIG_COMMAND_LIMIT; /* PWML is high so long */
    if (output->enable) {
        PIOC->PIO_SODR = ENABLE_PIN;
    }
}

/* ---- the tick ---- */

void TC3_Handler(void);
void TC3_Handler(void)
{
    (void)TC1->TC_CHANNEL[0].TC_SR; /* clears the request */
    station_board_tick();
}

void board_rate(uint32_t rate)
{
    reload = (uint32_t)((uint64_t)TIMER_HZ * 1000u / rate);
    clock_known = 0;
    TC1->TC_CHANNEL[0].TC_RC = reload;
    TC1->TC_CHANNEL[0].TC_CCR = TC_CCR_CLKEN | TC_CCR_SWTRG;
}

void board_read(station_input *input)
{
    input->encoder = (int32_t)TC0->TC_CHANNEL[0].TC_CV;
    input->accel = (int16_t)((int32_t)ADC->ADC_CDR[ADC_CHANNEL] - ADC_MIDDLE);
    input->clock = TC2->TC_CHANNEL[0].TC_CV;
    const uint32_t between = input->clock - last_clock;
    if (clock_known && between > reload + reload / 2u) {
        input->flags |= STATION_INPUT_OVERRUN;
    } else if (TC1->TC_CHANNEL[0].TC_CV > TIMER_HZ / 1000000u * STATION_LATE_WAKE_US) {
        input->flags |= STATION_INPUT_WOKE_LATE;
    }
    last_clock = input->clock;
    clock_known = 1;
    if (PIOC->PIO_PDSR & ESTOP_PIN) { /* normally closed to ground, pulled up */
        input->flags |= STATION_INPUT_ESTOP;
    }
}

uint32_t board_mask(void)
{
    const uint32_t before = NVIC_GetEnableIRQ(TC3_IRQn);
    NVIC_DisableIRQ(TC3_IRQn);
    return before;
}

void board_unmask(uint32_t before)
{
    if (before) {
        NVIC_EnableIRQ(TC3_IRQn);
    }
}

/* ---- the line ---- */

static void drain(void)
{
    while (ring_used(&line_out) > 0 && (UART->UART_SR & UART_SR_TXRDY)) {
        UART->UART_THR = ring_take(&line_out);
    }
    if (ring_used(&line_out) > 0) {
        UART->UART_IER = UART_SR_TXRDY;
    } else {
        UART->UART_IDR = UART_SR_TXRDY;
    }
}

void UART_Handler(void);
void UART_Handler(void)
{
    while (UART->UART_SR & UART_SR_RXRDY) {
        ring_put(&line_in, (uint8_t)UART->UART_RHR);
    }
    UART->UART_CR = UART_CR_RSTSTA; /* an overrun is a corrupt frame, which the core counts */
    drain();
}

uint16_t board_receive(uint8_t *bytes, uint16_t room)
{
    uint16_t count = 0;
    while (count < room && ring_used(&line_in) > 0) {
        bytes[count++] = ring_take(&line_in);
    }
    return count;
}

uint16_t board_room(void) { return ring_room(&line_out); }

void board_send(const uint8_t *bytes, uint16_t count)
{
    const uint32_t before = __get_PRIMASK();
    __disable_irq();
    for (uint16_t i = 0; i < count; i++) {
        ring_put(&line_out, bytes[i]);
    }
    drain();
    __set_PRIMASK(before);
}

/* ---- start ---- */

static uint8_t reset_cause(void)
{
    static const uint8_t causes[] = {STATION_RESET_POWER, STATION_RESET_POWER, STATION_RESET_WATCHDOG,
                                     STATION_RESET_SOFTWARE, STATION_RESET_PIN};
    const uint32_t type = RSTC->RSTC_SR >> RSTC_SR_RSTTYP_Pos & 7u;
    return type < sizeof causes ? causes[type] : STATION_RESET_UNKNOWN;
}

static void start_pins(void)
{
    PIOC->PIO_CODR = ENABLE_PIN;
    PIOC->PIO_PER = ENABLE_PIN | FORWARD_PIN | ESTOP_PIN;
    PIOC->PIO_OER = ENABLE_PIN | FORWARD_PIN;
    PIOC->PIO_ODR = ESTOP_PIN;
    PIOC->PIO_PUER = ESTOP_PIN;
    PIOC->PIO_ABSR |= PWM_PIN;        /* peripheral B: PWML5 */
    PIOB->PIO_ABSR |= ENCODER_PINS;   /* peripheral B: TIOA0, TIOB0 */
    PIOA->PIO_ABSR &= ~UART_PINS;     /* peripheral A: URXD, UTXD */
    PIOB->PIO_PDR = ENCODER_PINS;
    PIOA->PIO_PDR = UART_PINS;
}

static void start_timers(void)
{
    TC0->TC_CHANNEL[0].TC_CMR = TC_CMR_TCCLKS_XC0;
    TC0->TC_BMR = TC_BMR_QDEN | TC_BMR_POSEN | TC_BMR_EDGPHA | TC_BMR_MAXFILT(20);
    TC0->TC_CHANNEL[0].TC_CCR = TC_CCR_CLKEN | TC_CCR_SWTRG;
    TC1->TC_CHANNEL[0].TC_CMR = TC_CMR_WAVE | TC_CMR_WAVSEL_UP_RC | TC_CMR_TCCLKS_TIMER_CLOCK1;
    TC1->TC_CHANNEL[0].TC_IER = TC_IER_CPCS;
    TC2->TC_CHANNEL[0].TC_CMR = TC_CMR_WAVE | TC_CMR_TCCLKS_TIMER_CLOCK1;
    TC2->TC_CHANNEL[0].TC_CCR = TC_CCR_CLKEN | TC_CCR_SWTRG;
}

static void start_drive_and_sensor(void)
{
    PWM->PWM_CH_NUM[PWM_CHANNEL].PWM_CMR = 0; /* MCK, left aligned */
    PWM->PWM_CH_NUM[PWM_CHANNEL].PWM_CPRD = PWM_PERIOD;
    PWM->PWM_CH_NUM[PWM_CHANNEL].PWM_CDTY = 0;
    PWM->PWM_ENA = 1u << PWM_CHANNEL;
    PIOC->PIO_PDR = PWM_PIN;
    ADC->ADC_MR = ADC_MR_FREERUN_ON | ADC_MR_PRESCAL(3) | ADC_MR_STARTUP_SUT512;
    ADC->ADC_CHER = 1u << ADC_CHANNEL;
    ADC->ADC_CR = ADC_CR_START;
}

static void start_line(void)
{
    UART->UART_CR = UART_CR_RSTRX | UART_CR_RSTTX;
    UART->UART_MR = UART_MR_PAR_NO;
    UART->UART_BRGR = MCK / 16 / LINE_BAUD_RATE;
    UART->UART_CR = UART_CR_RXEN | UART_CR_TXEN;
    UART->UART_IER = UART_SR_RXRDY;
}

static uint32_t random_number(void)
{
    while (!(TRNG->TRNG_ISR & TRNG_ISR_DATRDY)) {
    }
    return TRNG->TRNG_ODATA;
}

uint32_t board_start(station_board *about)
{
    const station_board board = {
        .clock_hz = TIMER_HZ,
        .rate_min = RIG_RATE_MIN,
        .rate_max = RIG_RATE_MAX,
        .build = STATION_BUILD,
        .baud_rate = LINE_BAUD_RATE,
        .travel_limit = RIG_TRAVEL_LIMIT,
        .speed_limit = RIG_SPEED_LIMIT,
        .command_limit = RIG_COMMAND_LIMIT,
        .stall_command = RIG_STALL_COMMAND,
        .stall_time = RIG_STALL_TIME,
        .allowance = ALLOWANCE_US,
        .reset = reset_cause(),
        .name = RIG_NAME,
    };
    start_pins();
    SystemInit(); /* 84 MHz */
    WDT->WDT_MR = WDT_MR_WDV(WATCHDOG_TICKS) | WDT_MR_WDD(0xfff) | WDT_MR_WDRSTEN; /* can be written once */
    PMC->PMC_PCER0 = 1u << ID_UART | 1u << ID_PIOA | 1u << ID_PIOB | 1u << ID_PIOC | 1u << ID_TC0 | 1u << ID_TC3;
    PMC->PMC_PCER1 = 1u << (ID_TC6 - 32) | 1u << (ID_PWM - 32) | 1u << (ID_ADC - 32) | 1u << (ID_TRNG - 32);
    TRNG->TRNG_CR = TRNG_CR_ENABLE | TRNG_CR_KEY(0x524e47);
    start_timers();
    start_drive_and_sensor();
    start_line();
    *about = board;
    about->boot = random_number();
    NVIC_SetPriority(UART_IRQn, PRIORITY_LINE);
    NVIC_SetPriority(TC3_IRQn, PRIORITY_TICK);
    NVIC_EnableIRQ(UART_IRQn);
    NVIC_EnableIRQ(TC3_IRQn);
    return random_number();
}

void board_feed(void) { WDT->WDT_CR = WDT_CR_KEY(0xa5) | WDT_CR_WDRSTT; }

void board_rest(void) {} /* sleep would wait for the next interrupt with a sample that is ready to go */
