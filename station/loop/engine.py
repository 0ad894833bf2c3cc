"""One session at the device's pace: read a sample, answer it, record it.  Everything that drives a motor goes
through ``Session.run``, so that the motor's zero on every way out stands in one place."""

from __future__ import annotations

import gc
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from station.device.client import Client, Identity, state_words
from station.device.framing import encode
from station.device.limits import NO_LIMITS, DeviceLimits
from station.device.port import TIMEOUT
from station.device.protocol import MESSAGES, Fault, State, Status
from station.errors import WorkError
from station.loop.exchange import Exchange, Record

SILENCE_SECONDS = 0.5
"""A device that sends no sample for so long is lost, whatever else the line brings."""
VIRTUAL_SILENCE_SECONDS = 10.0
"""The same by this host's clock where the device's time is virtual: a busy machine may be slow, a dead line is not."""
SWITCH_SECONDS = 1e-4
"""Python's thread switch interval in a session in real time (5 ms otherwise: longer than a period)."""
CONFIRMED = "the motor is at zero, as the device confirms"
UNCONFIRMED = "no stop was confirmed: the device's own watchdog takes the motor to zero, not this host"
_SAMPLE, _COMMAND, _FAULT = MESSAGES["sample"], MESSAGES["command"], MESSAGES["fault"]
_MASK16 = 0xFFFF
_ADVICE = {
    Fault.HOST_SILENT: "see why the host was late, then start again",
    Fault.TRAVEL: "it went beyond limits.travel; bring the arm back, then ask for less",
    Fault.SPEED: "it went beyond limits.speed; ask for less, and see that the encoder counts well",
    Fault.STALLED: "the motor was driven and the encoder stood still; see what holds the arm, and the encoder's cable",
    Fault.OVERRUN: "the board missed a tick; take a lower sample rate",
    Fault.ESTOP: "its e-stop is open; close it, then start again",
    Fault.HOST_GONE: "it saw this host leave; check the cable, then start again",
}
"""What a person does about each fault of a device."""
_NAN = float("nan")
_REMEMBERED = 64
_UNANSWERED = int(Status.HELD | Status.ZEROED)


@dataclass
class Counts:
    """What a session counted.  From the host: ``samples`` recorded; ``lost``: ticks whose sample did not come in its
    turn, of which ``reordered`` came after a later one; ``duplicated`` samples that came again; ``corrupt`` frames
    that did not pass; ``unanswered``: recorded ticks on which the device had no command in time.

    From the device's own counters (-1 where it could not be asked): ``device_samples`` sent, ``commands`` taken,
    ``late`` commands, ``held`` and ``zeroed`` ticks, ``device_corrupt`` frames, ``woke_late`` ticks, and commands
    that were ``repeated``, ``limited``, ``refused`` (early or out of the window).  ``after_stop`` samples were sent
    beyond the last one wanted.  ``unsent`` samples found no room in the device's buffer (they are ``lost`` here),
    ``overruns`` ticks it missed itself.  Always device_samples + unsent = samples + lost + after_stop.
    """

    samples: int = 0
    lost: int = 0
    duplicated: int = 0
    reordered: int = 0
    corrupt: int = 0
    unanswered: int = 0
    device_samples: int = -1
    after_stop: int = -1
    commands: int = -1
    late: int = -1
    held: int = -1
    zeroed: int = -1
    repeated: int = -1
    limited: int = -1
    refused: int = -1
    device_corrupt: int = -1
    woke_late: int = -1
    unsent: int = -1
    overruns: int = -1

    def as_dict(self) -> dict[str, int]:
        """For metadata and JSON."""
        return asdict(self)


Respond = Callable[[int, int, int], int]
"""respond(row, encoder, accel): the command (whole counts) for tick row + answer_ticks."""


@contextmanager
def _undisturbed(paced: bool) -> Iterator[None]:
    """No garbage collection; where the device paces the loop, a log thread that gives way soon."""
    collecting, interval = gc.isenabled(), sys.getswitchinterval()
    gc.disable()
    if paced:
        sys.setswitchinterval(SWITCH_SECONDS)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        if collecting:
            gc.enable()


@dataclass(frozen=True)
class Setup:
    """What a session runs under: the device that was identified, rate in Hz, the command's limit in counts, the
    rig's limits of travel and speed."""

    identity: Identity
    rate: float
    limit: float
    answer_ticks: int = 1
    limits: DeviceLimits = NO_LIMITS

    def arm(self, client: Client) -> None:
        """A fresh identify, configure and arm, as each session needs; WorkError where the device was reset since."""
        again = client.identify()
        if again.boot != self.identity.boot:
            raise WorkError(f"{client.port.url}: the device was reset meanwhile; start again")
        client.configure(self.rate, min(math.floor(self.limit), self.identity.command_limit),
                         answer_ticks=self.answer_ticks, limits=self.limits)
        client.arm()


def _told(failure: WorkError | KeyboardInterrupt, confirmed: bool) -> WorkError | KeyboardInterrupt:
    """A session's failure with what became of its motor."""
    if isinstance(failure, WorkError):
        words = CONFIRMED if confirmed else UNCONFIRMED
        return WorkError(f"{failure}; {words}")
    return failure if confirmed else KeyboardInterrupt(UNCONFIRMED)


class Session:
    """A session on a device that was identified and is idle.  ``counts`` is filled in also where ``run`` raises.

    ``abort``: once it is set, the next sample is answered with the command 0 and a stop, and ``run`` raises
    KeyboardInterrupt.  ``exchange``: C handles the ordinary samples; ``respond`` and ``record`` are then its own.
    """

    def __init__(self, client: Client, setup: Setup, rows: int, respond: Respond, record: Record,
                 abort: threading.Event | None = None, exchange: Exchange | None = None) -> None:
        self.client = client
        self.counts = Counts()
        self._row = -1
        self._exchange = exchange
        self._setup, self._rows = setup, rows
        self._respond, self._record = respond, record
        self._abort = abort or threading.Event()
        self._missing: deque[int] = deque(maxlen=_REMEMBERED)  # rows whose sample did not come in its turn
        self._unanswered: int | None = None  # index of the command that the last sample still waits for

    @property
    def row(self) -> int:
        """The last row that a sample came for (-1: none), for a display to look at."""
        return self._row if self._exchange is None else max(self._row, self._exchange.shown)

    def run(self) -> Counts:
        """Arm, start, and run to the last row.  WorkError: the line was lost, the device went silent or into fault.

        Whatever ends it (the last row, an exception, Ctrl-C, a lost line), from before the device is armed on, the
        command 0 and a stop are sent; where they cannot be, the device's watchdog does the same.  What is raised says
        which of the two it was.
        """
        client = self.client
        corrupt = client.decoder.corrupt
        confirmed = started = False
        failure: WorkError | KeyboardInterrupt | None = None
        try:
            self._setup.arm(client)
            with _undisturbed(client.paced):
                corrupt = client.decoder.corrupt
                started = True
                client.start()
                self._loop()
        except (WorkError, KeyboardInterrupt) as error:
            failure = error
        finally:
            try:
                confirmed = client.halt(self._unanswered)
            finally:
                self.counts.corrupt = client.decoder.corrupt - corrupt
                self._count_left()
            if confirmed:
                self._ask_counters()
        if failure is not None:
            raise _told(failure, confirmed) if started else failure
        return self.counts

    def _loop(self) -> None:
        client, counts, rows, answer_ticks = self.client, self.counts, self._rows, self._setup.answer_ticks
        exchange, decoder, feed = self._exchange, client.decoder, client.decoder.feed
        read, write = client.port.read, client.port.write if exchange is None else exchange.write
        respond, record, now, session = self._respond, self._record, time.perf_counter, client.session
        unpack, pack = _SAMPLE.struct.unpack, _COMMAND.struct.pack
        sample_code, command_code, wire_size = _SAMPLE.code, _COMMAND.code, _SAMPLE.wire_size
        aborted = self._abort.is_set
        row, empty, received = -1, 0.0, now()
        heard = received  # when the last sample of this session came
        patience = SILENCE_SECONDS if client.paced else VIRTUAL_SILENCE_SECONDS
        encoder = accel = 0
        came = False
        bodies = list(client.inbox)
        client.inbox.clear()
        while True:
            for body in bodies:
                if body[0] != sample_code:
                    self._other(body, row)
                    continue
                _, index, clock, *readings, command, status = unpack(body)
                step = (index - row) & _MASK16
                if step == 0 or step >= 0x8000:
                    self._again(index)
                    continue
                if step > 1:  # the ticks between are lost: the compensator goes on with what it read last
                    step = min(step, rows - row)
                    counts.lost += step - 1
                    self._missing.extend(range(row + 1, row + step))
                    for missed in range(row + 1, row + step):
                        respond(missed, encoder, accel)
                row += step
                if row >= rows:
                    return
                heard, empty = received, 0.0
                encoder, accel = readings
                self._row = row
                self._unanswered = row + answer_ticks
                if status & _UNANSWERED:
                    counts.unanswered += 1
                counts.samples += 1
                if row == rows - 1:  # its answer is the command 0, sent with the stop
                    record(row, clock, encoder, accel, command, status, 0, received, now())
                    return
                try:
                    if aborted():
                        raise KeyboardInterrupt
                    answer = respond(row, encoder, accel)
                    write(encode(pack(command_code, self._unanswered & _MASK16, answer), session))
                except BaseException:
                    record(row, clock, encoder, accel, command, status, _NAN, received, _NAN)
                    raise
                written = now()
                self._unanswered = None
                record(row, clock, encoder, accel, command, status, answer, received, written)
            gone = received - heard
            # In virtual time, reads that wait are this machine's: a device in another process may be starved by it.
            if (empty >= SILENCE_SECONDS and (client.paced or gone < 0.5 * empty)) or gone > patience:
                raise WorkError(f"{client.port.url}: {'no sample came' if came else 'the device fell silent'} after "
                                f"row {row}; check cable and power")
            if exchange is None or decoder.overlong:
                data = read(max(wire_size - decoder.pending, 1))
                received, came = now(), bool(data)
            else:
                data, came = b"", self._exchange_ordinary(exchange, row, received)
                received = exchange.received
                if exchange.row > row:
                    row, heard, empty = exchange.row, exchange.heard, 0.0
                    encoder, accel = exchange.readings
            if not came:
                empty += TIMEOUT
            bodies = feed(data)

    def _exchange_ordinary(self, exchange: Exchange, row: int, received: float) -> bool:
        """Let C handle what is ordinary after a row; whether anything came.  Whatever ends it, its rows are counted."""
        exchange.begin(row, received, self.client.session)
        try:
            return exchange.run(self.client)
        finally:
            self._row = exchange.row
            self.counts.samples += exchange.row - row
            self.counts.unanswered += exchange.unanswered

    def _again(self, index: int) -> None:
        """A sample of a tick that has passed: one that was overtaken (lost, as its tick was answered without it)
        or one that came twice."""
        row = self._row - ((self._row - index) & _MASK16)
        if row in self._missing:
            self._missing.remove(row)
            self.counts.reordered += 1
        else:
            self.counts.duplicated += 1

    def _other(self, body: bytes, row: int) -> None:
        if body[0] == _FAULT.code:
            message = _FAULT.unpack(body)
            raise WorkError(f"{self.client.port.url}: the device went {state_words(State.FAULT, message.fault)} at "
                            f"row {row}; {_ADVICE.get(message.fault, 'see its cause')}")

    def _count_left(self) -> None:
        """Samples that came again and were still unread when the session ended."""
        for body in self.client.inbox:
            if body[0] == _SAMPLE.code and (self._row - (index := _SAMPLE.unpack(body).index)) & _MASK16 < 0x8000:
                self._again(index)
        self.client.inbox.clear()

    def _ask_counters(self) -> None:
        counts = self.counts
        try:
            found = self.client.statistics()
        except WorkError:
            return
        counts.device_samples = found.samples
        counts.unsent, counts.overruns = found.unsent_samples, found.overruns
        counts.after_stop = found.samples + found.unsent_samples - counts.samples - counts.lost
        counts.commands = found.commands
        counts.late, counts.held, counts.zeroed = found.late, found.held, found.zeroed
        counts.repeated, counts.limited = found.repeated, found.limited
        counts.refused = found.early + found.out_of_window
        counts.device_corrupt, counts.woke_late = found.corrupt, found.woke_late
