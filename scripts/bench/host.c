/* A bare host for the paced benchmark: the lead compensator over the same protocol, in C, with nothing around it.

   host tcp PORT | pty PATH    TICKS    RATE (mHz)

   Prints one line: ticks seen, ticks unanswered, ticks counted apart (the device itself began this tick or the one
   before late), unanswered among the others, faults, and the latency's median and 99th percentile in microseconds.
   Built from the firmware's own framing (firmware/core). */

#define _GNU_SOURCE
#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "frame.h"

enum { UNANSWERED = STATION_STATUS_HELD | STATION_STATUS_ZEROED, FIRST_ROWS = 125, HALF = 250 };

static int line;
static uint8_t frame[STATION_FRAME_BYTES];
static uint16_t filled;

static double now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

static void fail(const char *what)
{
    perror(what);
    exit(1);
}

static void send_body(const uint8_t *body, uint16_t length, uint16_t session)
{
    uint8_t wire[STATION_FRAME_BYTES];
    const uint16_t size = station_encode(body, length, session, wire);
    if (write(line, wire, size) != size) {
        fail("write");
    }
}

/* The next frame that passes in a session, at most `wait` ms from now; its code, or 0. */
static uint8_t receive(uint16_t session, int wait)
{
    static uint8_t bytes[4096];
    static ssize_t count, at;
    for (;;) {
        while (at < count) {
            const uint8_t byte = bytes[at++];
            if (byte != 0) {
                frame[filled < sizeof frame - 1 ? filled++ : filled] = byte;
                continue;
            }
            const uint16_t mixed = filled > 1 && frame[1] == STATION_CODE_SAMPLE ? session : 0;
            const uint16_t length = station_decode(frame, filled, mixed);
            filled = 0;
            if (length > 0 && station_body_size(frame[0]) == length) {
                return frame[0];
            }
        }
        struct pollfd ready = {.fd = line, .events = POLLIN};
        if (poll(&ready, 1, wait) <= 0) {
            return 0;
        }
        count = read(line, bytes, sizeof bytes);
        at = 0;
        if (count <= 0) {
            fail("read");
        }
    }
}

static void expect(uint8_t code)
{
    for (int tries = 0; tries < 1000; tries++) {
        if (receive(0, 1000) == code) {
            return;
        }
    }
    fprintf(stderr, "no answer\n");
    exit(1);
}

static void request(const uint8_t *body, uint16_t length)
{
    send_body(body, length, 0);
    expect(STATION_CODE_REPLY);
}

static void begin(uint16_t session, uint32_t rate)
{
    uint8_t body[64];
    body[0] = STATION_CODE_CLEAR;
    request(body, 1);
    const station_identify hello = {.version = STATION_PROTOCOL_VERSION, .hash = STATION_PROTOCOL_HASH};
    station_pack_identify(&hello, body);
    send_body(body, STATION_BODY_IDENTIFY, 0);
    expect(STATION_CODE_IDENTITY);
    station_identity identity;
    station_unpack_identity(frame, &identity);
    const station_configure configure = {.rate = rate, .command_limit = identity.command_limit, .hold_ticks = 1,
                                         .fault_ticks = 10, .answer_ticks = 1};
    station_pack_configure(&configure, body);
    request(body, STATION_BODY_CONFIGURE);
    const station_arm arm = {.challenge = identity.challenge};
    station_pack_arm(&arm, body);
    request(body, STATION_BODY_ARM);
    const station_start start = {.session = session, .challenge = identity.challenge};
    station_pack_start(&start, body);
    request(body, STATION_BODY_START);
}

static int by_size(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
    if (argc != 5) {
        fprintf(stderr, "host tcp PORT | pty PATH, TICKS, RATE\n");
        return 2;
    }
    if (strcmp(argv[1], "tcp") == 0) {
        struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(argv[2]))};
        address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        const int on = 1;
        line = socket(AF_INET, SOCK_STREAM, 0);
        if (line < 0 || connect(line, (struct sockaddr *)&address, sizeof address) != 0) {
            fail("connect");
        }
        setsockopt(line, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    } else {
        struct termios raw;
        line = open(argv[2], O_RDWR | O_NOCTTY);
        if (line < 0 || tcgetattr(line, &raw) != 0) {
            fail("open");
        }
        cfmakeraw(&raw);
        tcsetattr(line, TCSANOW, &raw);
        tcflush(line, TCIOFLUSH);
    }
    const long wanted = atol(argv[3]);
    double *latency = calloc((size_t)wanted + 1, sizeof *latency);
    long seen = 0, unanswered = 0, apart = 0, counted = 0, faults = 0;
    uint16_t session = (uint16_t)(getpid() % 65000 + 1);
    while (seen < wanted) {
        double error_before = 0.0, out = 0.0;
        int woke_late_before = 0;
        begin(++session, (uint32_t)atol(argv[4]));
        while (seen < wanted) {
            const uint8_t code = receive(session, 1000);
            const double received = now();
            if (code == STATION_CODE_FAULT || code == 0) {
                faults++;
                break;
            }
            if (code != STATION_CODE_SAMPLE) {
                continue;
            }
            station_sample sample;
            station_unpack_sample(frame, &sample);
            const double reference = sample.index < FIRST_ROWS || sample.index / HALF % 2 ? 0.0 : 50.0;
            const double error = reference - sample.encoder;
            out = 18.32547182 * error - 17.20911971 * error_before + 0.77672958 * out;
            out = out > 200.0 ? 200.0 : out < -200.0 ? -200.0 : out;
            error_before = error;
            const int rounded = (int)(out + 1000.5) - 1000;
            uint8_t body[STATION_BODY_COMMAND];
            const station_command command = {.index = (uint16_t)(sample.index + 1), .command = (int16_t)rounded};
            station_pack_command(&command, body);
            send_body(body, sizeof body, session);
            latency[seen++] = now() - received;
            const int late = (sample.status & STATION_STATUS_WOKE_LATE) != 0;
            const int missed = (sample.status & UNANSWERED) != 0;
            unanswered += missed;
            if (late || woke_late_before) {
                apart++;
            } else {
                counted += missed;
            }
            woke_late_before = late;
        }
        uint8_t stop[1] = {STATION_CODE_STOP};
        request(stop, 1);
    }
    qsort(latency, (size_t)seen, sizeof *latency, by_size);
    printf("%ld %ld %ld %ld %ld %.1f %.1f\n", seen, unanswered, apart, counted, faults, 1e6 * latency[seen / 2],
           1e6 * latency[seen * 99 / 100]);
    return 0;
}
