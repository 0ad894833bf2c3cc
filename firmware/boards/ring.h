/* Bytes between a line's interrupt and the main loop: one puts, one takes. */

#ifndef STATION_RING_H
#define STATION_RING_H

#include <stdint.h>

enum { RING_BYTES = 512 }; /* a power of two */

typedef struct {
    volatile uint16_t in, out;
    uint8_t bytes[RING_BYTES];
} ring;

static inline uint16_t ring_used(const ring *r) { return (uint16_t)((r->in - r->out) & (RING_BYTES - 1)); }

static inline uint16_t ring_room(const ring *r) { return (uint16_t)(RING_BYTES - 1 - ring_used(r)); }

/* What finds no room is lost; the frame that it belongs to is then corrupt and counted. */
static inline void ring_put(ring *r, uint8_t byte)
{
    if (ring_room(r) > 0) {
        r->bytes[r->in] = byte;
        r->in = (uint16_t)((r->in + 1) & (RING_BYTES - 1));
    }
}

static inline uint8_t ring_take(ring *r)
{
    const uint8_t byte = r->bytes[r->out];
    r->out = (uint16_t)((r->out + 1) & (RING_BYTES - 1));
    return byte;
}

#endif
