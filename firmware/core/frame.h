/* Frames: COBS, three bytes of check, one zero byte at the end.  See protocol.toml. */

#ifndef STATION_FRAME_H
#define STATION_FRAME_H

#include <stdint.h>

#include "protocol.h"

enum { STATION_CRC_START = 0xffff, STATION_FRAME_MARGIN = 2 + STATION_CHECK_BYTES /* COBS, check, delimiter */ };

/* CRC-16 CCITT (0x1021, high bit first) of the bytes, going on from `crc`. */
uint16_t station_crc(uint16_t crc, const uint8_t *bytes, uint16_t length);

/* Writes the frame of a body of at most STATION_FRAME_BYTES - STATION_FRAME_MARGIN bytes to `wire` (so many bytes
   longer); returns its length.  `session` is 0 for frames of scope "link". */
uint16_t station_encode(const uint8_t *body, uint16_t length, uint16_t session, uint8_t *wire);

/* Undoes COBS in place; returns the number of bytes, 0 where the stuffing is not right. */
uint16_t station_unstuff(uint8_t *frame, uint16_t length);

/* Turns a frame without its delimiter into its body, in place; returns the body's length, 0 where the check or the
   stuffing is not right.  The body's code stands in frame[1] before that. */
uint16_t station_decode(uint8_t *frame, uint16_t length, uint16_t session);

#endif
