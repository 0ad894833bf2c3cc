#include "frame.h"

uint16_t station_crc(uint16_t crc, const uint8_t *bytes, uint16_t length)
{
    uint32_t value = crc;
    for (uint16_t i = 0; i < length; i++) {
        value = ((value >> 8) | (value << 8)) & 0xffffu;
        value ^= bytes[i];
        value ^= (value & 0xffu) >> 4;
        value ^= (value << 12) & 0xffffu;
        value ^= (value & 0xffu) << 5;
    }
    return (uint16_t)value;
}

static void write_check(uint16_t crc, uint8_t *to)
{
    to[0] = (uint8_t)(0x40u | crc >> 10);
    to[1] = (uint8_t)(0x40u | (crc >> 5 & 0x1fu));
    to[2] = (uint8_t)(0x40u | (crc & 0x1fu));
}

uint16_t station_encode(const uint8_t *body, uint16_t length, uint16_t session, uint8_t *wire)
{
    uint16_t code = 0; /* where the distance to the next zero goes */
    uint16_t at = 1;
    for (uint16_t i = 0; i < length; i++) {
        if (body[i] == 0) {
            wire[code] = (uint8_t)(at - code);
            code = at;
        } else {
            wire[at] = body[i];
        }
        at++;
    }
    wire[code] = (uint8_t)(at - code);
    write_check(station_crc((uint16_t)(STATION_CRC_START ^ session), wire, at), wire + at);
    at = (uint16_t)(at + STATION_CHECK_BYTES);
    wire[at++] = 0;
    return at;
}

uint16_t station_unstuff(uint8_t *frame, uint16_t length)
{
    uint16_t read = 0;
    uint16_t written = 0;
    while (read < length) {
        const uint8_t code = frame[read++];
        if (code == 0 || code - 1 > length - read) {
            return 0;
        }
        for (uint8_t i = 1; i < code; i++) {
            frame[written++] = frame[read++];
        }
        if (code < 0xff && read < length) {
            frame[written++] = 0;
        }
    }
    return written;
}

uint16_t station_decode(uint8_t *frame, uint16_t length, uint16_t session)
{
    uint8_t check[STATION_CHECK_BYTES];
    if (length < STATION_CHECK_BYTES) {
        return 0;
    }
    const uint16_t stuffed = (uint16_t)(length - STATION_CHECK_BYTES);
    write_check(station_crc((uint16_t)(STATION_CRC_START ^ session), frame, stuffed), check);
    for (uint16_t i = 0; i < STATION_CHECK_BYTES; i++) {
        if (frame[stuffed + i] != check[i]) {
            return 0;
        }
    }
    return station_unstuff(frame, stuffed);
}
