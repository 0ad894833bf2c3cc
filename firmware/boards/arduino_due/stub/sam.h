/* A stand-in for Atmel's CMSIS device header of the SAM3X8E: the registers that arduino_due.c uses, at the addresses
   and with the names of the data sheet (Atmel 11057C), so that the board can be compiled without the device pack.
   Never part of an image. */

#ifndef STATION_STUB_SAM_H
#define STATION_STUB_SAM_H

#include <stdint.h>

typedef volatile uint32_t RoReg, RwReg, WoReg;

typedef struct {
    WoReg TC_CCR;
    RwReg TC_CMR, TC_SMMR;
    RoReg Reserved1;
    RoReg TC_CV;
    RwReg TC_RA, TC_RB, TC_RC;
    RoReg TC_SR;
    WoReg TC_IER, TC_IDR;
    RoReg TC_IMR, Reserved2[4];
} TcChannel;

typedef struct {
    TcChannel TC_CHANNEL[3];
    WoReg TC_BCR;
    RwReg TC_BMR;
} Tc;

typedef struct {
    WoReg PIO_PER, PIO_PDR;
    RoReg PIO_PSR, Reserved1;
    WoReg PIO_OER, PIO_ODR;
    RoReg PIO_OSR, Reserved2;
    WoReg PIO_IFER, PIO_IFDR;
    RoReg PIO_IFSR, Reserved3;
    WoReg PIO_SODR, PIO_CODR;
    RwReg PIO_ODSR;
    RoReg PIO_PDSR;
    WoReg PIO_IER, PIO_IDR;
    RoReg PIO_IMR, PIO_ISR;
    WoReg PIO_MDER, PIO_MDDR;
    RoReg PIO_MDSR, Reserved4;
    WoReg PIO_PUDR, PIO_PUER;
    RoReg PIO_PUSR, Reserved5;
    RwReg PIO_ABSR;
} Pio;

typedef struct {
    RwReg PWM_CMR, PWM_CDTY;
    WoReg PWM_CDTYUPD;
    RwReg PWM_CPRD;
    WoReg PWM_CPRDUPD;
    RoReg PWM_CCNT;
    RwReg PWM_DT;
    WoReg PWM_DTUPD;
} PwmCh_num;

typedef struct {
    RwReg PWM_CLK;
    WoReg PWM_ENA, PWM_DIS;
    RoReg PWM_SR, Reserved[124];
    PwmCh_num PWM_CH_NUM[8];
} Pwm;

typedef struct {
    WoReg ADC_CR;
    RwReg ADC_MR, ADC_SEQR1, ADC_SEQR2;
    WoReg ADC_CHER, ADC_CHDR;
    RoReg ADC_CHSR, Reserved1, ADC_LCDR;
    WoReg ADC_IER, ADC_IDR;
    RoReg ADC_IMR, ADC_ISR, Reserved2[2], ADC_OVER;
    RwReg ADC_EMR, ADC_CWR, ADC_CGR, ADC_COR;
    RoReg ADC_CDR[16];
} Adc;

typedef struct {
    WoReg UART_CR;
    RwReg UART_MR;
    WoReg UART_IER, UART_IDR;
    RoReg UART_IMR, UART_SR, UART_RHR;
    WoReg UART_THR;
    RwReg UART_BRGR;
} Uart;

typedef struct {
    WoReg WDT_CR;
    RwReg WDT_MR;
    RoReg WDT_SR;
} Wdt;

typedef struct {
    WoReg RSTC_CR;
    RoReg RSTC_SR;
    RwReg RSTC_MR;
} Rstc;

typedef struct {
    WoReg PMC_SCER, PMC_SCDR;
    RoReg PMC_SCSR, Reserved1;
    WoReg PMC_PCER0, PMC_PCDR0;
    RoReg PMC_PCSR0, Reserved2[57];
    WoReg PMC_PCER1, PMC_PCDR1;
} Pmc;

typedef struct {
    WoReg TRNG_CR;
    RoReg Reserved1[6], TRNG_ISR, Reserved2[12], TRNG_ODATA;
} Trng;

#define TC0 ((Tc *)0x40080000U)
#define TC1 ((Tc *)0x40084000U)
#define TC2 ((Tc *)0x40088000U)
#define TRNG ((Trng *)0x400BC000U)
#define PWM ((Pwm *)0x40094000U)
#define ADC ((Adc *)0x400C0000U)
#define PMC ((Pmc *)0x400E0600U)
#define UART ((Uart *)0x400E0800U)
#define PIOA ((Pio *)0x400E0E00U)
#define PIOB ((Pio *)0x400E1000U)
#define PIOC ((Pio *)0x400E1200U)
#define RSTC ((Rstc *)0x400E1A00U)
#define WDT ((Wdt *)0x400E1A50U)

#define ID_UART 8
#define ID_PIOA 11
#define ID_PIOB 12
#define ID_PIOC 13
#define ID_TC0 27
#define ID_TC3 30
#define ID_TC6 33
#define ID_PWM 36
#define ID_ADC 37
#define ID_TRNG 41

#define TC_CCR_CLKEN (1u << 0)
#define TC_CCR_SWTRG (1u << 2)
#define TC_CMR_TCCLKS_TIMER_CLOCK1 (0u << 0) /* MCK / 2 */
#define TC_CMR_TCCLKS_XC0 (5u << 0)
#define TC_CMR_WAVE (1u << 15)
#define TC_CMR_WAVSEL_UP_RC (2u << 13)
#define TC_IER_CPCS (1u << 4)
#define TC_BMR_QDEN (1u << 8)
#define TC_BMR_POSEN (1u << 9)
#define TC_BMR_EDGPHA (1u << 12)
#define TC_BMR_MAXFILT(value) ((0x3fu & (value)) << 20)
#define ADC_MR_FREERUN_ON (1u << 7)
#define ADC_MR_PRESCAL(value) ((0xffu & (value)) << 8)
#define ADC_MR_STARTUP_SUT512 (8u << 16)
#define ADC_CR_START (1u << 1)
#define UART_CR_RSTRX (1u << 2)
#define UART_CR_RSTTX (1u << 3)
#define UART_CR_RXEN (1u << 4)
#define UART_CR_TXEN (1u << 6)
#define UART_CR_RSTSTA (1u << 8)
#define UART_MR_PAR_NO (4u << 9)
#define UART_SR_RXRDY (1u << 0)
#define UART_SR_TXRDY (1u << 1)
#define WDT_CR_KEY(value) ((0xffu & (value)) << 24)
#define WDT_CR_WDRSTT (1u << 0)
#define WDT_MR_WDV(value) (0xfffu & (value))
#define WDT_MR_WDRSTEN (1u << 13)
#define WDT_MR_WDD(value) ((0xfffu & (value)) << 16)
#define RSTC_SR_RSTTYP_Pos 8
#define TRNG_ISR_DATRDY (1u << 0)
#define TRNG_CR_ENABLE (1u << 0)
#define TRNG_CR_KEY(value) ((0xffffffu & (value)) << 8)

typedef enum { UART_IRQn = 8, TC3_IRQn = 30 } IRQn_Type;

void NVIC_EnableIRQ(IRQn_Type irq);
void NVIC_SetPriority(IRQn_Type irq, uint32_t priority);
void NVIC_DisableIRQ(IRQn_Type irq);
uint32_t NVIC_GetEnableIRQ(IRQn_Type irq);
void __disable_irq(void);
void __enable_irq(void);
uint32_t __get_PRIMASK(void);
void __set_PRIMASK(uint32_t mask);
void SystemInit(void);

#endif
