/* A stand-in for the project.h that PSoC Creator generates: declarations alone, so that board sources can be compiled
   (not linked) without PSoC Creator.  Names and types are those of the component APIs: cy_boot 5.x (CyLib), Quadrature
   Decoder 3.0 (32 bits), ADC SAR 3.x, PWM 3.x (16 bits, one output), Timer 2.x (32 bits), USBFS 3.x (USBUART),
   Interrupt 1.7, digital Pins 2.x, Control Register 1.x.  Never part of a PSoC Creator project. */

#ifndef STATION_STUB_PROJECT_H
#define STATION_STUB_PROJECT_H

#include <stdint.h>

typedef uint8_t uint8;
typedef uint16_t uint16;
typedef uint32_t uint32;
typedef int16_t int16;
typedef int32_t int32;
typedef volatile uint32_t reg32;

/* ---- cy_boot ---- */

typedef void (*cyisraddress)(void);
#define CY_ISR(name) void name(void)
#define CY_ISR_PROTO(name) void name(void)
#define CY_NOINIT __attribute__((section(".noinit")))
#define CyGlobalIntEnable do { __asm volatile("cpsie i"); } while (0)

extern uint8 CyResetStatus;
#define CY_RESET_LVID (0x01u)
#define CY_RESET_LVIA (0x02u)
#define CY_RESET_HVIA (0x04u)
#define CY_RESET_WD (0x08u)
#define CY_RESET_SW (0x20u)

#define CYWDT_16_TICKS (0x1u)
#define CYWDT_LPMODE_NOCHANGE (0x00u)
#define CYDEV_BCLK__MASTER_CLK__HZ 64000000u

uint8 CyEnterCriticalSection(void);
void CyExitCriticalSection(uint8 savedIntrStatus);
void CyWdtStart(uint8 ticks, uint8 lpMode);
void CyWdtClear(void);
void CyILO_Start1K(void);
void CyGetUniqueId(uint32 *uniqueId);

/* ---- components, by the names of the schematic ---- */

void Encoder_Start(void);
int32 Encoder_GetCounter(void);

void Accel_Start(void);
void Accel_StartConvert(void);
int16 Accel_GetResult16(void);

void Drive_PWM_Start(void);
void Drive_PWM_WriteCompare(uint16 compare);
uint16 Drive_PWM_ReadPeriod(void);

void Drive_Forward_Write(uint8 value);
void Drive_Enable_Write(uint8 value);
uint8 EStop_Read(void);

void Tick_Timer_Start(void);
void Tick_Timer_Stop(void);
uint8 Tick_Timer_ReadStatusRegister(void);
void Tick_Timer_WritePeriod(uint32 period);
void Tick_Timer_WriteCounter(uint32 counter);
uint32 Tick_Timer_ReadPeriod(void);
uint32 Tick_Timer_ReadCounter(void);
#define Tick_Timer_STATUS_TC (0x01u)

void Clock_Timer_Start(void);
uint32 Clock_Timer_ReadCounter(void);

void Tick_Isr_StartEx(cyisraddress address);
void Tick_Isr_SetPriority(uint8 priority);
void Tick_Isr_Disable(void);
void Tick_Isr_Enable(void);
uint8 Tick_Isr_GetState(void);
void Tick_Isr_ClearPending(void);

#define USBUART_5V_OPERATION (0x01u)
#define USBUART_LINE_CONTROL_DTR (0x01u)
void USBUART_Start(uint8 device, uint8 mode);
uint8 USBUART_CDC_Init(void);
uint8 USBUART_GetConfiguration(void);
uint8 USBUART_IsConfigurationChanged(void);
uint8 USBUART_CDCIsReady(void);
uint8 USBUART_DataIsReady(void);
uint16 USBUART_GetAll(uint8 *pData);
void USBUART_PutData(const uint8 *pData, uint16 length);
uint16 USBUART_GetLineControl(void);

void UART_Start(void);
uint8 UART_GetRxBufferSize(void);
uint8 UART_ReadRxData(void);
uint8 UART_GetTxBufferSize(void);
void UART_PutArray(const uint8 string[], uint8 byteCount);

#endif
