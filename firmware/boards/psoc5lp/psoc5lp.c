/* PSoC 5LP (CY8CKIT-059 and others), for PSoC Creator.  Compiled against declarations of the generated component API;
   never run on a board: see README.md, which also has the schematic's components and their settings. */

#include "limits.h"
#include "project.h"

#include "board.h"

enum {
    CLOCK_HZ = 24000000,   /* Clock_Timer and Tick_Timer: BUS_CLK / n, see README.md */
    USB_PACKET = 64,       /* bytes of a full-speed bulk endpoint */
    USB_ALLOWANCE = 2000,  /* us: a USB frame each way */
    UART_ALLOWANCE = 2000, /* us: the line goes to a USB adapter */
    UART_BUFFER = 250,     /* bytes of the component's transmit buffer that we fill */
    TICK_PRIORITY = 2      /* below USB's and UART's, which only move bytes */
};

static volatile uint8 gone = 1;
static volatile uint32 last_clock;
static volatile uint8 clock_known;

/* ---- the drive ---- */

void board_drive(const station_output *output)
{
    const int16_t drive = output->enable ? output->drive : 0;
    const uint32 size = (uint32)(drive < 0 ? -drive : drive);
    if (!output->enable) {
        Drive_Enable_Write(0u);
    }
    Drive_Forward_Write(drive >= 0);
    Drive_PWM_WriteCompare((uint16)(size * ((uint32)Drive_PWM_ReadPeriod() + 1u) / (uint32)RIG_COMMAND_LIMIT));
    if (output->enable) {
        Drive_Enable_Write(1u);
    }
}

/* ---- the tick ---- */

CY_ISR_PROTO(tick_isr);
CY_ISR(tick_isr)
{
    (void)Tick_Timer_ReadStatusRegister(); /* clears the request */
    station_board_tick();
}

void board_rate(uint32_t rate)
{
    const uint32 period = (uint32)((uint64_t)CLOCK_HZ * 1000u / rate);
    Tick_Timer_Stop();
    Tick_Timer_WritePeriod(period - 1u);
    Tick_Timer_WriteCounter(period - 1u);
    clock_known = 0;
    Tick_Timer_Start();
}

void board_read(station_input *input)
{
    input->encoder = Encoder_GetCounter();
    input->accel = Accel_GetResult16();
    const uint32 period = Tick_Timer_ReadPeriod() + 1u;
    const uint32 since = period - 1u - Tick_Timer_ReadCounter();
    input->clock = ~Clock_Timer_ReadCounter();
    const uint32 between = input->clock - last_clock;
    if (clock_known && between > period + period / 2u) {
        input->flags |= STATION_INPUT_OVERRUN;
    } else if (since > CLOCK_HZ / 1000000u * STATION_LATE_WAKE_US) {
        input->flags |= STATION_INPUT_WOKE_LATE;
    }
    last_clock = input->clock;
    clock_known = 1;
    if (EStop_Read() != 0u) { /* normally closed to ground, pulled up: open, or a broken wire, reads 1 */
        input->flags |= STATION_INPUT_ESTOP;
    }
    if (gone) {
        input->flags |= STATION_INPUT_HOST_GONE;
    }
}

uint32_t board_mask(void)
{
    const uint8 before = Tick_Isr_GetState();
    Tick_Isr_Disable();
    return before;
}

void board_unmask(uint32_t before)
{
    if (before) {
        Tick_Isr_Enable();
    }
}

/* ---- the line ---- */

#if LINE_USB

static uint8 line_up;
static uint8 packet[USB_PACKET];
static uint16 packet_bytes, packet_read;

static void watch_usb(void)
{
    if (USBUART_GetConfiguration() == 0u) {
        line_up = 0;
        gone = 1;
        return;
    }
    if (USBUART_IsConfigurationChanged() != 0u || !line_up) {
        (void)USBUART_CDC_Init();
        line_up = 1;
        packet_bytes = packet_read = 0;
    }
    gone = (USBUART_GetLineControl() & USBUART_LINE_CONTROL_DTR) == 0u;
}

uint16_t board_receive(uint8_t *bytes, uint16_t room)
{
    uint16_t count = 0;
    watch_usb();
    if (packet_read == packet_bytes && line_up && USBUART_DataIsReady() != 0u) {
        packet_bytes = USBUART_GetAll(packet);
        packet_read = 0;
    }
    while (count < room && packet_read < packet_bytes) {
        bytes[count++] = packet[packet_read++];
    }
    return count;
}

uint16_t board_room(void)
{
    return line_up && USBUART_CDCIsReady() != 0u ? USB_PACKET - 1 : 0; /* a full packet would need an empty one after it */
}

void board_send(const uint8_t *bytes, uint16_t count) { USBUART_PutData(bytes, count); }

#else

uint16_t board_receive(uint8_t *bytes, uint16_t room)
{
    uint16_t count = 0;
    while (count < room && UART_GetRxBufferSize() > 0u) {
        bytes[count++] = UART_ReadRxData();
    }
    return count;
}

uint16_t board_room(void)
{
    const uint16_t used = UART_GetTxBufferSize();
    return used < UART_BUFFER ? (uint16_t)(UART_BUFFER - used) : 0;
}

void board_send(const uint8_t *bytes, uint16_t count) { UART_PutArray(bytes, (uint8)count); }

#endif

/* ---- start ---- */

static uint8_t reset_cause(void)
{
    if (CyResetStatus & CY_RESET_WD) {
        return STATION_RESET_WATCHDOG;
    }
    if (CyResetStatus & CY_RESET_SW) {
        return STATION_RESET_SOFTWARE;
    }
    if (CyResetStatus & (CY_RESET_LVID | CY_RESET_LVIA | CY_RESET_HVIA)) {
        return STATION_RESET_BROWNOUT;
    }
    return STATION_RESET_UNKNOWN; /* power-on and the reset pin leave no trace that tells them apart */
}

uint32_t board_start(station_board *about)
{
    const station_output off = {0};
    uint32 unique[2];
    Drive_Enable_Write(0u);
    Drive_PWM_Start();
    board_drive(&off);
    Encoder_Start();
    Accel_Start();
    Accel_StartConvert(); /* free running */
    Clock_Timer_Start();
    CyGetUniqueId(unique);
    static volatile uint32 kept CY_NOINIT; /* RAM as the power-up or the last run left it */
    kept = kept * 1664525u + 1013904223u;
    const uint32 entropy = unique[0] ^ unique[1] ^ kept ^ ((uint32)(uint16)Accel_GetResult16() << 16);
    const station_board board = {
        .boot = entropy * 0x9e3779b9u,
        .clock_hz = CLOCK_HZ,
        .rate_min = RIG_RATE_MIN,
        .rate_max = RIG_RATE_MAX,
        .build = STATION_BUILD,
        .baud_rate = LINE_USB ? 0 : LINE_BAUD_RATE,
        .travel_limit = RIG_TRAVEL_LIMIT,
        .speed_limit = RIG_SPEED_LIMIT,
        .command_limit = RIG_COMMAND_LIMIT,
        .stall_command = RIG_STALL_COMMAND,
        .stall_time = RIG_STALL_TIME,
        .allowance = LINE_USB ? USB_ALLOWANCE : UART_ALLOWANCE,
        .reset = reset_cause(),
        .name = RIG_NAME,
    };
    *about = board;
#if LINE_USB
    USBUART_Start(0u, USBUART_5V_OPERATION);
#else
    UART_Start();
    gone = 0;
#endif
    Tick_Isr_StartEx(tick_isr);
    Tick_Isr_SetPriority(TICK_PRIORITY);
    CyGlobalIntEnable;
    CyILO_Start1K();
    CyWdtStart(CYWDT_16_TICKS, CYWDT_LPMODE_NOCHANGE); /* 32 to 48 ms */
    return entropy;
}

void board_feed(void) { CyWdtClear(); }

void board_rest(void) {} /* USB is polled */
