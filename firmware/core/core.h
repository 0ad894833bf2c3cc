/* The firmware's core: what every board runs.  No heap, no board header, no floating point.

   A board owns one station_core and calls
     station_init      once after reset, with its description and a number that differs from one power-up to the next;
     station_receive   with the bytes that the line brought, from the main loop;
     station_tick      from the timer interrupt, with the sensors read at this tick; it sets the drive;
     station_transmit  to fetch bytes for the line, from the main loop or the transmit interrupt.
   The board sees to it that these never interrupt one another (the tick masked while the others run; each is bounded:
   station_receive by the bytes given, at most one frame's work per delimiter).  After station_receive the board
   applies what station_present says: a stop does not wait for the next tick.  While output.enable is 0 the drive's
   enable pin is inactive.

   Commands.  The host answers the sample of tick i with the command for tick i + answer_ticks.  A command
     for the coming tick, or one of those whose sample was sent, is latched and applied exactly at its tick;
     for a tick that has passed is late: counted, not used;
     for a tick whose sample was not sent yet is early: counted, not used;
     for a tick that has its command already is repeated: counted, the first one stands;
     beyond +-STATION_INDEX_WINDOW ticks is out of the window: counted, not used;
     beyond the limit is cut to the limit: counted, and the status of its tick says so.
   A tick without a command holds the last one for at most hold_ticks ticks in a row; then the drive is 0; after
   fault_ticks such ticks in a row the device is in fault, which only `clear` leaves.  What else happens in which
   state stands in firmware/states.toml.  */

#ifndef STATION_CORE_H
#define STATION_CORE_H

#include <stdint.h>

#include "protocol.h"
#include "states.h"

/* declarations: begin (Python reads what stands between these two lines) */

enum { STATION_TRANSMIT_BYTES = 256, STATION_SLOTS = 4 };

typedef struct { /* what a board is; constant.  configure can only tighten the limits */
    uint32_t boot;         /* random number of this power-up */
    uint32_t clock_hz;     /* of input.clock */
    uint32_t rate_min;     /* mHz, at least 1 */
    uint32_t rate_max;     /* mHz */
    uint32_t build;        /* hash of the sources */
    uint32_t baud_rate;    /* of a UART; 0: the line has none */
    uint32_t travel_limit; /* counts from where a session began; 0: none */
    uint16_t speed_limit;  /* counts within STATION_SPEED_TICKS ticks; 0: none */
    int16_t command_limit; /* counts */
    int16_t stall_command; /* counts; a larger drive must move the encoder ... */
    uint16_t stall_time;   /* ... within so many ms; both 0: none */
    uint16_t allowance;    /* us of each answer's time, for host and adapter */
    uint16_t flags;        /* STATION_BOARD_... */
    uint8_t reset;         /* STATION_RESET_... */
    char name[16];
} station_board;

typedef struct { /* what the board reads at a tick, before the tick's command acts */
    uint32_t clock;
    int32_t encoder; /* counts, free running, wraps */
    int16_t accel;   /* counts */
    uint16_t flags;  /* STATION_INPUT_... */
} station_input;

typedef struct { /* what the board does at a tick */
    int16_t drive;   /* counts, in force until the next tick */
    uint16_t status; /* STATION_STATUS_... */
    uint8_t enable;  /* 1 while running */
} station_output;

typedef struct {
    station_board board;
    station_configure config;        /* the limits that hold */
    uint32_t counts[STATION_COUNTS]; /* of this session, STATION_COUNT_... */
    uint32_t challenge;
    uint32_t random;
    uint32_t encoder_zero;
    int32_t encoder; /* counts from the zero, at the last tick */
    int32_t rest_encoder;
    uint32_t rest_ticks;      /* so long within one count of rest_encoder */
    uint32_t rest_ticks_need; /* so many make a rest */
    int32_t origin;           /* where the session began */
    int32_t stall_encoder;
    uint32_t stall_ticks; /* so long driven without leaving stall_encoder */
    uint32_t stall_ticks_need;
    uint32_t armed_ticks;                /* left until armed ends */
    int32_t past[STATION_SPEED_TICKS];   /* the encoder at the last ticks, a ring */
    uint8_t past_at;
    uint8_t past_known;
    uint16_t zeroings;
    uint16_t session;     /* of the run that is on, or was */
    uint16_t next_index;  /* of the coming tick */
    uint16_t first_ticks; /* ticks to come that cannot have a command yet */
    uint16_t silent;      /* ticks in a row without a command */
    uint16_t news;        /* status bits since the last sample */
    int16_t drive;        /* what is applied now */
    uint8_t state;
    uint8_t fault;
    uint8_t trusted;    /* the host's protocol is ours */
    uint8_t configured; /* since the last identify */
    uint8_t spent;      /* the challenge has armed once */
    uint8_t begun;      /* the session has had a tick */
    uint8_t estop;      /* its circuit was open at the last tick */
    uint8_t slot_full[STATION_SLOTS];
    uint8_t slot_cut[STATION_SLOTS];
    int16_t slot_command[STATION_SLOTS];
    uint16_t received;
    uint16_t transmit;
    uint8_t receive_bytes[STATION_FRAME_BYTES];
    uint8_t transmit_bytes[STATION_TRANSMIT_BYTES];
} station_core;

void station_init(station_core *core, const station_board *board, uint32_t entropy);
void station_receive(station_core *core, const uint8_t *bytes, uint16_t length);
void station_tick(station_core *core, const station_input *input, station_output *output);
void station_present(const station_core *core, station_output *output); /* drive and enable as they are now */
uint16_t station_transmit(station_core *core, uint8_t *bytes, uint16_t capacity);

/* declarations: end */

#endif
