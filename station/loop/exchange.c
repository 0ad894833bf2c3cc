/* The ordinary samples of a session: each is read, answered, written back and recorded here.

   Whatever is not ordinary (a sample that is lost, repeated or the last, another message, a frame that does not pass, a
   write that is not whole, an abort, what the guard complains of) is left to Python (station/loop/engine.py) as if
   nothing of it had been seen: the rules stand there, once.  The compensator is that of station/control/compensators.py,
   the guard that of station/loop/safety.py, operation by operation; a test holds them equal bit for bit. */

#define _POSIX_C_SOURCE 200809L
#define _DARWIN_C_SOURCE
#include <errno.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "frame.h"

typedef _Atomic int32_t shared_int;

/* declarations: begin (Python reads them, too; shared_int is an int32_t there) */
enum { EXCHANGE_ORDER = 16, EXCHANGE_SPEED_TICKS = 8, EXCHANGE_BYTES = 4096 };

/* What exchange_respond says. */
enum { EXCHANGE_FINE, EXCHANGE_TRAVEL, EXCHANGE_SPEED, EXCHANGE_STALLED, EXCHANGE_NO_NUMBER };

/* Why exchange_run returned: bytes that Python must handle, none for so long, a line that may be lost, a signal. */
enum { EXCHANGE_OTHER, EXCHANGE_QUIET, EXCHANGE_LINE, EXCHANGE_SIGNAL };

typedef struct { /* one row of the log */
    double sent, received, written;
    uint32_t clock;
    int32_t encoder;
    int16_t accel, command;
    uint16_t status, recorded;
} exchange_row;

typedef struct { /* what a sample changes; the latest value stands first */
    double errors[EXCHANGE_ORDER], outputs[EXCHANGE_ORDER], accels[EXCHANGE_ORDER], shaped[EXCHANGE_ORDER];
    double readings[EXCHANGE_ORDER];
    int32_t begun, stood, still, at, last[EXCHANGE_SPEED_TICKS];
} exchange_state;

typedef struct {
    double numerator[EXCHANGE_ORDER], denominator[EXCHANGE_ORDER];
    double accel_numerator[EXCHANGE_ORDER], accel_denominator[EXCHANGE_ORDER], feedback[EXCHANGE_ORDER];
    double accel_zero, limit, level;
    int32_t order, accel_order, readings, open_loop;
    int32_t start, patience;
    uint32_t travel, speed;
    const double *reference; /* count + answer_ticks values */
    exchange_row *rows;
    int32_t count, answer_ticks, line, signals;
    uint16_t session;
    int32_t answer, row, encoder, accel, unanswered, begun;
    int32_t came; /* whether bytes came */
    double command, moved; /* what is complained of */
    double heard, received;
    uint32_t taken, filled;
    uint8_t bytes[EXCHANGE_BYTES];
    exchange_state state;
    shared_int published, aborted;
} exchange;

/* The answer (counts) to a row's readings, in x->answer, or what the guard complains of. */
int32_t exchange_respond(exchange *x, int32_t row, int32_t encoder, int32_t accel);
/* Handles samples until something is not ordinary, or none comes for `patience` seconds. */
int32_t exchange_run(exchange *x, double patience);
void exchange_publish(exchange *x, int32_t row);
int32_t exchange_published(exchange *x);
void exchange_abort(exchange *x);
uint32_t exchange_size(void);
/* declarations: end */

uint32_t exchange_size(void) { return sizeof(exchange); }

/* Rows below the published one are whole, for whichever thread looks. */
void exchange_publish(exchange *x, int32_t row)
{
    atomic_store_explicit(&x->published, row + 1, memory_order_release);
}

int32_t exchange_published(exchange *x) { return atomic_load_explicit(&x->published, memory_order_acquire); }

/* From now on every sample is Python's. */
void exchange_abort(exchange *x) { atomic_store(&x->aborted, 1); }

/* Python's time.perf_counter. */
static double now(void)
{
    struct timespec at;
#ifdef __APPLE__
    clock_gettime(CLOCK_UPTIME_RAW, &at);
#else
    clock_gettime(CLOCK_MONOTONIC, &at);
#endif
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

static void push(double *values, int32_t count, double value)
{
    for (int32_t i = count - 1; i > 0; i--) {
        values[i] = values[i - 1];
    }
    values[0] = value;
}

static double sum(const double *factors, const double *values, int32_t count)
{
    double out = 0.0;
    for (int32_t i = 0; i < count; i++) {
        out += factors[i] * values[i];
    }
    return out;
}

/* Compensator.step, with Compensator.shape inside. */
static double step(exchange *x, double reference, int32_t encoder, int32_t accel)
{
    exchange_state *s = &x->state;
    double out = reference;
    if (!x->open_loop) {
        if (x->accel_order > 0) {
            push(s->accels, x->accel_order, accel - x->accel_zero);
            double shaped = sum(x->accel_numerator, s->accels, x->accel_order);
            shaped -= sum(x->accel_denominator + 1, s->shaped, x->accel_order - 1);
            push(s->shaped, x->accel_order, shaped);
            reference -= shaped;
        }
        push(s->errors, x->order, reference - encoder);
        out = sum(x->numerator, s->errors, x->order);
        out -= sum(x->denominator + 1, s->outputs, x->order - 1);
        if (x->readings > 0) {
            for (int32_t i = s->begun ? 1 : x->readings; i > 0; i--) {
                push(s->readings, x->readings, encoder);
            }
            s->begun = 1;
            out -= sum(x->feedback, s->readings, x->readings);
        }
    }
    const double low = 0.0 - x->limit;
    out = low > out ? low : out;
    out = x->limit < out ? x->limit : out;
    if (!x->open_loop) {
        push(s->outputs, x->order, out);
    }
    return out;
}

static int64_t apart(int32_t a, int32_t b) { return a < b ? (int64_t)b - a : (int64_t)a - b; }

/* Guard.see */
static int32_t see(exchange *x, int32_t encoder)
{
    exchange_state *s = &x->state;
    const int64_t travel = apart(encoder, x->start), speed = apart(encoder, s->last[s->at]);
    s->last[s->at] = encoder;
    s->at = (s->at + 1) % EXCHANGE_SPEED_TICKS;
    if (x->travel > 0 && travel > x->travel) {
        x->moved = (double)travel;
        return EXCHANGE_TRAVEL;
    }
    x->moved = (double)speed;
    return x->speed > 0 && speed > x->speed ? EXCHANGE_SPEED : EXCHANGE_FINE;
}

/* Guard.drive */
static int32_t drive(exchange *x, int32_t encoder, double command)
{
    exchange_state *s = &x->state;
    if ((command < 0.0 ? -command : command) < x->level || apart(encoder, s->stood) > 1) {
        s->stood = encoder;
        s->still = 0;
        return EXCHANGE_FINE;
    }
    s->still++;
    return s->still >= x->patience ? EXCHANGE_STALLED : EXCHANGE_FINE;
}

int32_t exchange_respond(exchange *x, int32_t row, int32_t encoder, int32_t accel)
{
    int32_t complaint = x->travel > 0 || x->speed > 0 ? see(x, encoder) : EXCHANGE_FINE;
    x->answer = 0;
    if (complaint != EXCHANGE_FINE || row >= x->count - x->answer_ticks) {
        return complaint;
    }
    x->command = step(x, x->reference[row + x->answer_ticks], encoder, accel);
    if (x->command != x->command) {
        return EXCHANGE_NO_NUMBER;
    }
    complaint = drive(x, encoder, x->command);
    if (complaint != EXCHANGE_FINE) {
        return complaint;
    }
    const double up = x->command + 0.5;
    const int32_t whole = (int32_t)up; /* the limit is an int16_t's */
    x->answer = whole - (up < whole ? 1 : 0);
    return EXCHANGE_FINE;
}

/* Whether the frame is the next sample, and is answered and recorded; where it is not, nothing has changed. */
static int ordinary(exchange *x, const uint8_t *frame, size_t length)
{
    uint8_t body[STATION_FRAME_BYTES], wire[STATION_FRAME_BYTES];
    const int32_t row = x->row + 1;
    if (length > STATION_FRAME_BYTES || row >= x->count - 1 || atomic_load(&x->aborted)) {
        return 0;
    }
    memcpy(body, frame, length);
    station_sample sample;
    if (station_decode(body, (uint16_t)length, x->session) != STATION_BODY_SAMPLE || body[0] != STATION_CODE_SAMPLE) {
        return 0;
    }
    station_unpack_sample(body, &sample);
    if (sample.index != (uint16_t)((uint32_t)row & 0xffffu)) {
        return 0;
    }
    const exchange_state before = x->state;
    if (exchange_respond(x, row, sample.encoder, sample.accel) != EXCHANGE_FINE) {
        x->state = before;
        return 0;
    }
    const station_command command = {.index = (uint16_t)((uint32_t)(row + x->answer_ticks) & 0xffffu),
                                     .command = (int16_t)x->answer};
    station_pack_command(&command, body);
    const uint16_t size = station_encode(body, STATION_BODY_COMMAND, x->session, wire);
    const ssize_t written = write(x->line, wire, size);
    if (written != size) { /* Python works the same answer out again and writes what is left of it */
        x->begun = written > 0 ? (int32_t)written : 0;
        x->state = before;
        return 0;
    }
    x->rows[row] = (exchange_row){.sent = x->answer, .received = x->received, .written = now(), .clock = sample.clock,
                                  .encoder = sample.encoder, .accel = sample.accel, .command = sample.command,
                                  .status = sample.status, .recorded = 1};
    exchange_publish(x, row);
    x->unanswered += (sample.status & (STATION_STATUS_HELD | STATION_STATUS_ZEROED)) != 0;
    x->encoder = sample.encoder;
    x->accel = sample.accel;
    x->heard = x->received;
    x->row = row;
    return 1;
}

int32_t exchange_run(exchange *x, double patience)
{
    double until = now() + patience;
    for (;;) {
        const uint8_t *end;
        while ((end = memchr(x->bytes + x->taken, 0, x->filled - x->taken)) != NULL) {
            const size_t length = (size_t)(end - (x->bytes + x->taken));
            if (!ordinary(x, x->bytes + x->taken, length)) {
                return EXCHANGE_OTHER;
            }
            x->taken += (uint32_t)length + 1;
            until = x->received + patience;
        }
        x->filled -= x->taken;
        memmove(x->bytes, x->bytes + x->taken, x->filled);
        x->taken = 0;
        if (x->filled >= STATION_FRAME_BYTES) { /* a frame without an end */
            return EXCHANGE_OTHER;
        }
        struct pollfd ready[2] = {{.fd = x->line, .events = POLLIN}, {.fd = x->signals, .events = POLLIN}};
        const double left = until - now();
        const int count = left > 0.0 ? poll(ready, 2, (int)(1e3 * left) + 1) : 0;
        if (count == 0) {
            x->received = now();
            return EXCHANGE_QUIET;
        }
        if (count < 0 && errno == EINTR) { /* ready[1] tells of it where it is this thread's to handle */
            continue;
        }
        if (count > 0 && ready[1].revents != 0) {
            return EXCHANGE_SIGNAL;
        }
        const ssize_t got = count > 0 && (ready[0].revents & POLLIN) != 0
                                ? read(x->line, x->bytes + x->filled, EXCHANGE_BYTES - x->filled) : 0;
        x->received = now();
        if (got == 0 || (got < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR)) {
            return EXCHANGE_LINE;
        }
        x->filled += got > 0 ? (uint32_t)got : 0;
        x->came |= got > 0;
    }
}
