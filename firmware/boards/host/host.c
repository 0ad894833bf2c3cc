/* The host board: the core as a plain shared library.  Python plays the timer interrupt, the line and the rig
   (station/device/core.py); here stands only what lets it check that both sides see the same structures. */

#include <stddef.h>

#include "core.h"
#include "frame.h"

/* declarations: begin */

typedef struct {
    const char *name;
    uint32_t size;
} station_size;

extern const station_size station_sizes[]; /* ends with a name of 0 */
uint32_t station_protocol_hash(void);
uint16_t station_encode(const uint8_t *body, uint16_t length, uint16_t session, uint8_t *wire);
uint16_t station_unstuff(uint8_t *frame, uint16_t length);
uint16_t station_decode(uint8_t *frame, uint16_t length, uint16_t session);
uint16_t station_crc(uint16_t crc, const uint8_t *bytes, uint16_t length);

/* declarations: end */

#define SIZE(message) {"station_" #message, sizeof(station_##message)},

const station_size station_sizes[] = {
    STATION_MESSAGES(SIZE)
    SIZE(board) SIZE(input) SIZE(output) SIZE(core) SIZE(size)
    {NULL, 0},
};

uint32_t station_protocol_hash(void) { return STATION_PROTOCOL_HASH; }
