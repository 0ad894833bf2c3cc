/* What a board must offer to run the core.  A new board is one file that implements this header; run.c does the rest.

   The interrupt of the sample clock calls station_board_tick and nothing else. */

#ifndef STATION_BOARD_H
#define STATION_BOARD_H

#include <stdint.h>

#include "core.h"

#ifndef STATION_BUILD
#define STATION_BUILD 0u /* the build number that the device tells; -DSTATION_BUILD=0x... from the build */
#endif

/* ---- what a board implements ---- */

/* Once, after reset: the drive's enable pin inactive and its PWM at zero first of all, then clocks, sensors, line and
   watchdog, the tick not yet running.  Fills in what the board is; returns a number that differs from one power-up to
   the next. */
uint32_t board_start(station_board *about);

/* Tick at so many mHz from now on, within the bounds that the board has stated. */
void board_rate(uint32_t rate);

/* The sensors at this tick, the clock and what the board knows of itself (STATION_INPUT_...). */
void board_read(station_input *input);

/* The drive and its enable pin, from the tick and after each request; twice the same does no harm. */
void board_drive(const station_output *output);

/* Keep the tick out, and let it in again. */
uint32_t board_mask(void);
void board_unmask(uint32_t before);

/* The line: takes up to `room` bytes that have come; the bytes that would be taken now; gives it `count` of those. */
uint16_t board_receive(uint8_t *bytes, uint16_t room);
uint16_t board_room(void);
void board_send(const uint8_t *bytes, uint16_t count);

/* Feeds the hardware watchdog; called when both the tick and the main loop have run since the last time. */
void board_feed(void);

/* Nothing to do until the next interrupt; may return at once. */
void board_rest(void);

/* ---- what run.c offers ---- */

extern station_core station_board_core;

void station_board_tick(void);
void station_board_turn(void); /* one turn of the main loop */

#endif
