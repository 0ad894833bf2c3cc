/* Written by `python -m station.device.header` from firmware/protocol.toml.  Do not edit. */

#ifndef STATION_PROTOCOL_H
#define STATION_PROTOCOL_H

#include <stdint.h>

#define STATION_PROTOCOL_HASH 0x911b7a37u

enum {
    STATION_PROTOCOL_VERSION = 2,
    STATION_CHECK_BYTES = 3,
    STATION_FRAME_BYTES = 128,
    STATION_INDEX_WINDOW = 8,
    STATION_ANSWER_TICKS_MAX = 4,
    STATION_HOLD_TICKS_DEFAULT = 1,
    STATION_HOLD_TICKS_MAX = 5,
    STATION_FAULT_TICKS_DEFAULT = 10,
    STATION_FAULT_TIME_MAX_MS = 50,
    STATION_ARMED_TIME_MS = 2000,
    STATION_SPEED_TICKS = 8,
    STATION_STALL_COUNTS = 1,
    STATION_LINE_BITS_PER_BYTE = 10,
    STATION_REST_TIME_MS = 200,
    STATION_LATE_WAKE_US = 100,
    STATION_CODE_IDENTIFY = 0x01,
    STATION_CODE_CONFIGURE = 0x02,
    STATION_CODE_ARM = 0x03,
    STATION_CODE_START = 0x04,
    STATION_CODE_COMMAND = 0x05,
    STATION_CODE_STOP = 0x06,
    STATION_CODE_CLEAR = 0x07,
    STATION_CODE_ZERO = 0x08,
    STATION_CODE_QUERY = 0x09,
    STATION_CODE_IDENTITY = 0x81,
    STATION_CODE_REPLY = 0x82,
    STATION_CODE_SAMPLE = 0x83,
    STATION_CODE_FAULT = 0x84,
    STATION_CODE_STATISTICS = 0x85,
    STATION_BODY_IDENTIFY = 9,
    STATION_BODY_CONFIGURE = 20,
    STATION_BODY_ARM = 5,
    STATION_BODY_START = 7,
    STATION_BODY_COMMAND = 5,
    STATION_BODY_STOP = 1,
    STATION_BODY_CLEAR = 1,
    STATION_BODY_ZERO = 1,
    STATION_BODY_QUERY = 1,
    STATION_BODY_IDENTITY = 73,
    STATION_BODY_REPLY = 11,
    STATION_BODY_SAMPLE = 17,
    STATION_BODY_FAULT = 4,
    STATION_BODY_STATISTICS = 73,
    STATION_STATE_IDLE = 0,
    STATION_STATE_ARMED = 1,
    STATION_STATE_RUNNING = 2,
    STATION_STATE_FAULT = 3,
    STATION_RESULT_OK = 0,
    STATION_RESULT_WRONG_STATE = 1,
    STATION_RESULT_WRONG_PROTOCOL = 2,
    STATION_RESULT_STALE = 3,
    STATION_RESULT_NOT_CONFIGURED = 4,
    STATION_RESULT_OUT_OF_RANGE = 5,
    STATION_RESULT_MOVING = 6,
    STATION_RESULT_ESTOP_OPEN = 7,
    STATION_RESULT_LINE_TOO_SLOW = 8,
    STATION_FAULT_NONE = 0,
    STATION_FAULT_HOST_SILENT = 1,
    STATION_FAULT_TRAVEL = 2,
    STATION_FAULT_SPEED = 3,
    STATION_FAULT_STALLED = 4,
    STATION_FAULT_OVERRUN = 5,
    STATION_FAULT_ESTOP = 6,
    STATION_FAULT_HOST_GONE = 7,
    STATION_RESET_POWER = 0,
    STATION_RESET_PIN = 1,
    STATION_RESET_WATCHDOG = 2,
    STATION_RESET_SOFTWARE = 3,
    STATION_RESET_BROWNOUT = 4,
    STATION_RESET_UNKNOWN = 5,
    STATION_STATUS_RUNNING = 0x0001,
    STATION_STATUS_FAULT = 0x0002,
    STATION_STATUS_HELD = 0x0004,
    STATION_STATUS_ZEROED = 0x0008,
    STATION_STATUS_LATE = 0x0010,
    STATION_STATUS_EARLY = 0x0020,
    STATION_STATUS_REPEATED = 0x0040,
    STATION_STATUS_SATURATED = 0x0080,
    STATION_STATUS_CORRUPT = 0x0100,
    STATION_STATUS_WOKE_LATE = 0x0200,
    STATION_STATUS_MOVING = 0x0400,
    STATION_STATUS_ESTOP = 0x0800,
    STATION_STATUS_OVERRUN = 0x1000,
    STATION_BOARD_VIRTUAL_TIME = 0x0001,
    STATION_INPUT_WOKE_LATE = 0x0001,
    STATION_INPUT_OVERRUN = 0x0002,
    STATION_INPUT_ESTOP = 0x0004,
    STATION_INPUT_HOST_GONE = 0x0008,
};

/* identify; from the host */
typedef struct {
    uint16_t version; /* the host's protocol version */
    uint32_t hash; /* the host's protocol hash */
    uint16_t nonce; /* another one each time: tells its answer from those that the line has stored */
} station_identify;

/* idle only; a limit can only be tightened below what is compiled in, 0 leaves it (but command_limit: 0 is 0); from the host */
typedef struct {
    uint32_t rate; /* mHz, sample rate */
    int16_t command_limit; /* counts, largest command, 0 to the board's own */
    uint8_t hold_ticks; /* ticks */
    uint8_t fault_ticks; /* ticks */
    uint8_t answer_ticks; /* ticks, a sample's answer acts so many ticks later */
    uint32_t travel_limit; /* counts, from where the session began */
    uint16_t speed_limit; /* counts per speed_ticks ticks */
    int16_t stall_command; /* counts, a larger command must move the encoder */
    uint16_t stall_time; /* ms, ... within this time */
} station_configure;

/* idle only, after identify and configure; a challenge serves once, and no old line knows it; from the host */
typedef struct {
    uint32_t challenge;
} station_arm;

/* armed only; the next tick is tick 0; from the host */
typedef struct {
    uint16_t session; /* random, not 0 */
    uint32_t challenge; /* the one that armed: who did not arm cannot start */
} station_start;

/* command; from the host */
typedef struct {
    uint16_t index; /* the tick from which it is in force */
    int16_t command; /* counts */
} station_command;

/* identity; from the device */
typedef struct {
    uint16_t version;
    uint32_t hash;
    uint16_t nonce; /* of the identify that is answered */
    uint32_t challenge; /* new at each identify; arm and start must give it back */
    uint32_t boot; /* random number of this power-up */
    uint16_t zeroings; /* how often the encoder was zeroed since */
    uint32_t clock_hz; /* Hz, of the clock in samples */
    uint32_t rate_min; /* mHz */
    uint32_t rate_max; /* mHz */
    int16_t command_limit; /* counts, compiled in, as the limits below */
    uint32_t travel_limit; /* counts, 0: none */
    uint16_t speed_limit; /* counts per speed_ticks ticks, 0: none */
    int16_t stall_command; /* counts, 0: none */
    uint16_t stall_time; /* ms, 0: none */
    uint32_t baud_rate; /* bit/s, of a UART; 0: the line has none */
    uint16_t allowance; /* us, of each tick's answer, for host and adapter */
    uint16_t flags; /* flags.board */
    uint32_t build; /* hash of the firmware's sources */
    uint8_t reset; /* enums.reset */
    uint8_t state; /* enums.state */
    char board[16]; /* the board's name */
} station_identity;

/* to configure, arm, start, stop, clear and zero; from the device */
typedef struct {
    uint8_t request; /* code of the message answered */
    uint8_t result; /* enums.result */
    uint8_t state; /* enums.state, after it */
    uint8_t fault; /* enums.fault */
    uint16_t status; /* flags.status */
    int32_t encoder; /* counts */
} station_reply;

/* sample; from the device */
typedef struct {
    uint16_t index; /* the tick */
    uint32_t clock; /* the board's clock at the tick */
    int32_t encoder; /* counts */
    int16_t accel; /* counts */
    int16_t command; /* counts, in force from this tick on */
    uint16_t status; /* flags.status */
} station_sample;

/* sent once when the fault is entered; from the device */
typedef struct {
    uint8_t fault; /* enums.fault */
    uint16_t index; /* the tick at which */
} station_fault;

/* counts since the last start; from the device */
typedef struct {
    uint8_t state; /* enums.state */
    uint8_t fault; /* enums.fault */
    uint16_t status; /* flags.status */
    int32_t encoder; /* counts */
    uint32_t samples; /* samples sent */
    uint32_t unsent_samples; /* samples that the transmit buffer had no room for */
    uint32_t unsent_frames; /* frames that it had no room for, samples included */
    uint32_t commands; /* commands latched for their tick */
    uint32_t held; /* ticks that held the last command */
    uint32_t zeroed; /* ticks at zero for want of a command */
    uint32_t late; /* commands that came after their tick, not used */
    uint32_t early; /* commands for a tick whose sample was not sent yet, not used */
    uint32_t repeated; /* second commands for the same tick, not used */
    uint32_t out_of_window; /* commands with an index beyond the window, not used */
    uint32_t limited; /* commands cut to the limit */
    uint32_t corrupt; /* frames that did not pass */
    uint32_t woke_late; /* ticks that began late on the board's own clock */
    uint32_t overruns; /* ticks before which the board missed one */
    uint32_t refused; /* requests refused */
    uint32_t faults; /* faults entered */
} station_statistics;

void station_pack_identify(const station_identify *in, uint8_t *body);
void station_unpack_identify(const uint8_t *body, station_identify *out);
void station_pack_configure(const station_configure *in, uint8_t *body);
void station_unpack_configure(const uint8_t *body, station_configure *out);
void station_pack_arm(const station_arm *in, uint8_t *body);
void station_unpack_arm(const uint8_t *body, station_arm *out);
void station_pack_start(const station_start *in, uint8_t *body);
void station_unpack_start(const uint8_t *body, station_start *out);
void station_pack_command(const station_command *in, uint8_t *body);
void station_unpack_command(const uint8_t *body, station_command *out);
void station_pack_identity(const station_identity *in, uint8_t *body);
void station_unpack_identity(const uint8_t *body, station_identity *out);
void station_pack_reply(const station_reply *in, uint8_t *body);
void station_unpack_reply(const uint8_t *body, station_reply *out);
void station_pack_sample(const station_sample *in, uint8_t *body);
void station_unpack_sample(const uint8_t *body, station_sample *out);
void station_pack_fault(const station_fault *in, uint8_t *body);
void station_unpack_fault(const uint8_t *body, station_fault *out);
void station_pack_statistics(const station_statistics *in, uint8_t *body);
void station_unpack_statistics(const uint8_t *body, station_statistics *out);
uint8_t station_body_size(uint8_t code);

/* Every message that has fields. */
#define STATION_MESSAGES(X) \
    X(identify) X(configure) X(arm) X(start) X(command) X(identity) X(reply) X(sample) X(fault) X(statistics)

#endif
