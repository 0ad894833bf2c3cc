/* The main loop and the body of the tick's interrupt, the same on every board. */

#include "board.h"

enum { CHUNK = 64 };

station_core station_board_core;

static volatile uint8_t ticked;
static uint32_t rate;

void station_board_tick(void)
{
    station_input input = {0};
    station_output output;
    board_read(&input);
    station_tick(&station_board_core, &input, &output);
    board_drive(&output);
    ticked = 1;
}

static void receive(const uint8_t *bytes, uint16_t count)
{
    station_output output = {0};
    const uint32_t before = board_mask();
    station_receive(&station_board_core, bytes, count);
    station_present(&station_board_core, &output);
    board_drive(&output);
    board_unmask(before);
    if (station_board_core.config.rate != rate) {
        rate = station_board_core.config.rate;
        board_rate(rate);
    }
}

void station_board_turn(void)
{
    uint8_t bytes[CHUNK];
    uint16_t count = board_receive(bytes, CHUNK);
    const uint16_t came = count;
    if (came > 0) {
        receive(bytes, came);
    }
    const uint16_t room = board_room();
    const uint32_t before = board_mask();
    count = station_transmit(&station_board_core, bytes, room < CHUNK ? room : CHUNK);
    board_unmask(before);
    if (count > 0) {
        board_send(bytes, count);
    }
    if (ticked) {
        ticked = 0;
        board_feed();
    }
    if (came == 0 && count == 0) {
        board_rest();
    }
}

int main(void)
{
    static station_board about;
    const uint32_t entropy = board_start(&about);
    station_init(&station_board_core, &about, entropy);
    rate = station_board_core.config.rate;
    board_rate(rate);
    for (;;) {
        station_board_turn();
    }
}
