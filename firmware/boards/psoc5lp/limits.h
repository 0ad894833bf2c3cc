/* What is compiled into the board: to be set for the rig before the first power-on.  configure can only tighten it. */

#ifndef STATION_LIMITS_H
#define STATION_LIMITS_H

#define RIG_NAME "sflr"       /* at most 16 letters */
#define RIG_COMMAND_LIMIT 200 /* counts; full scale of the PWM */
#define RIG_TRAVEL_LIMIT 1024 /* encoder counts from where a session began: one turn; 0: none */
#define RIG_SPEED_LIMIT 60    /* encoder counts within 8 ticks: 23 rad/s at 500 Hz, 1024 counts a turn; 0: none */
#define RIG_STALL_COMMAND 100 /* counts; a larger command must move the encoder ... */
#define RIG_STALL_TIME 1000   /* ... within so many ms; both 0: none */
#define RIG_RATE_MIN 100000   /* mHz; the watchdog wants a tick at least every 32 ms */
#define RIG_RATE_MAX 1000000  /* mHz */
#ifndef LINE_USB
#define LINE_USB 1 /* 1: USBUART (the chip's own USB connector); 0: UART, to the kit's or another adapter */
#endif
#define LINE_BAUD_RATE 921600 /* of the UART, as set in its component */

#endif
