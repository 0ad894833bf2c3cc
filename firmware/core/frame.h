/* Frames: COBS, CRC-16 CCITT, one zero byte at the end.  See protocol.toml. */

#ifndef STATION_FRAME_H
#define STATION_FRAME_H

#include <stdint.h>

#include "protocol.h"

enum { STATION_CRC_START = 0xffff };

/* CRC-16 CCITT (0x1021, high bit first) of the bytes, going on from `crc`. */
uint16_t station_crc(uint16_t crc, const uint8_t *bytes, uint16_t length);

/* Writes the frame of a body of at most STATION_FRAME_BYTES - 4 bytes to `wire` (length + 4 bytes); returns its
   length.  `session` is 0 for frames of scope "link". */
uint16_t station_encode(const uint8_t *body, uint16_t length, uint16_t session, uint8_t *wire);

/* Undoes COBS in place on a frame without its delimiter; returns the number of bytes (body and CRC), 0 where the
   stuffing is not right. */
uint16_t station_unstuff(uint8_t *frame, uint16_t length);

#endif
