"""The compiled sample path (``exchange.c``) from Python: built, filled, and its rows brought to the log.

C answers the ordinary samples of a session without the interpreter; ``Session`` handles the others, and asks C for
their answers, too, so that the states of compensator and guard exist once.  Every row goes into one array; a thread of
its own takes it from there to the log.  For plain serial ports and sockets on POSIX; never run on macOS.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from cffi import FFI

from station.control.compensators import Compensator
from station.device.build import build_library
from station.device.client import Client
from station.device.firmware import firmware_folder
from station.device.limits import SPEED_TICKS
from station.device.port import TIMEOUT, Port
from station.errors import StationError, WorkError
from station.loop.safety import Guard

COMPILED, INTERPRETED = "compiled", "python"
SOURCE = Path(__file__).with_suffix(".c")
FLAGS = ("-ffp-contract=off",)
"""No fused multiplication and addition: the results are Python's, bit for bit."""
PERIOD = 0.01
"""Seconds between two looks of the thread that takes rows to the log: of the 50 ms that a killed host may lose."""
_BEGIN, _END = "/* declarations: begin", "/* declarations: end"
_ROW = np.dtype([("sent", "f8"), ("received", "f8"), ("written", "f8"), ("clock", "u4"), ("encoder", "i4"),
                 ("accel", "i2"), ("command", "i2"), ("status", "u2"), ("recorded", "u2")])

Record = Callable[[int, int, int, int, int, int, float, float, float], None]
"""record(row, clock, encoder, accel, command, status, sent, received, written): one sample and its answer; sent and
written are NaN where something broke before the answer was out."""


def sources() -> list[Path]:
    """The C file and what it takes of the firmware core."""
    core = firmware_folder() / "core"
    return [SOURCE, *(core / name for name in ("frame.c", "frame.h", "protocol.c", "protocol.h"))]


@cache
def library() -> tuple[FFI, Any]:
    """cffi's handle and the library, built where needed; WorkError where it cannot be."""
    ffi = FFI()
    text = SOURCE.read_text(encoding="utf-8")
    part = text[text.index(_BEGIN):text.index(_END)]
    ffi.cdef("typedef int32_t shared_int;\n" + part[part.index("*/") + 2:])
    path = build_library("exchange", sources(), FLAGS)
    try:
        lib = ffi.dlopen(str(path))
    except OSError as error:
        raise WorkError(f"{path}: the compiled sample path cannot be loaded ({error}); remove it") from None
    if (lib.exchange_size(), ffi.sizeof("exchange_row"), lib.EXCHANGE_SPEED_TICKS) != (
            ffi.sizeof("exchange"), _ROW.itemsize, SPEED_TICKS):
        raise WorkError(f"{path}: not of these sources; remove it")
    return ffi, lib


def sample_path(port: Port, compensator: Compensator) -> str:
    """How samples will be answered at this port: ``compiled``, or ``python``, with the reason where C was wanted."""
    if port.descriptor is None or type(compensator) is not Compensator:
        return INTERPRETED
    try:
        library()
    except StationError as error:
        return f"{INTERPRETED} ({error})"
    return COMPILED


class Exchange:
    """The compiled path of one session.  reference: counts, one value per row.  ``respond`` and ``record`` are what
    ``Session`` takes; ``row`` to ``received`` are of the last ``run``."""

    def __init__(self, port: Port, compensator: Compensator, guard: Guard, reference: np.ndarray,
                 answer_ticks: int) -> None:
        ffi, self._lib = library()
        self._port, self._guard = port, guard
        self.failure: BaseException | None = None
        count = len(reference)
        self._reference = np.concatenate([np.asarray(reference, dtype=float), np.zeros(answer_ticks)])
        self._rows = np.empty(count, _ROW)
        self._rows.fill(0)  # all pages are there before the first sample
        self._delivered = 0
        x = self._x = ffi.new("exchange *", {
            "numerator": compensator.numerator.tolist(), "denominator": compensator.denominator.tolist(),
            "accel_numerator": compensator.accel_numerator.tolist(), "feedback": compensator.feedback.tolist(),
            "accel_denominator": compensator.accel_denominator.tolist(), "accel_zero": compensator.accel_zero,
            "limit": compensator.limit, "order": compensator.denominator.size, "readings": compensator.feedback.size,
            "accel_order": compensator.accel_denominator.size, "open_loop": compensator.open_loop,
            "level": guard.level, "patience": guard.patience, "start": guard.start, "travel": guard.limits.travel,
            "speed": guard.limits.speed, "count": count, "answer_ticks": answer_ticks, "signals": -1, "row": -1,
            "line": -1 if port.descriptor is None else port.descriptor,
            "state": {"stood": guard.start, "last": [guard.start] * SPEED_TICKS}})
        x.reference = ffi.cast("double *", self._reference.ctypes.data)
        x.rows = ffi.cast("exchange_row *", self._rows.ctypes.data)
        self._bytes = ffi.buffer(x.bytes)
        self._wakes: tuple[int, int] | None = None

    @property
    def row(self) -> int:
        """The row of the last sample that C has answered, or was told of."""
        return self._x.row

    @property
    def shown(self) -> int:
        """The last row that is recorded, for other threads (-1: none)."""
        return self._lib.exchange_published(self._x) - 1

    @property
    def unanswered(self) -> int:
        """Ticks among the rows of the last ``run`` on which the device had no command in time."""
        return self._x.unanswered

    @property
    def readings(self) -> tuple[int, int]:
        """Encoder and accelerometer (counts) of the last ordinary sample."""
        return self._x.encoder, self._x.accel

    @property
    def heard(self) -> float:
        """When the last ordinary sample came (s)."""
        return self._x.heard

    @property
    def received(self) -> float:
        """When the line was last looked at (s)."""
        return self._x.received

    def respond(self, row: int, encoder: int, accel: int) -> int:
        """The command (counts) for tick row + answer_ticks.  WorkError: the guard's; what the log's thread raised."""
        x, lib = self._x, self._lib
        if self.failure is not None:
            raise self.failure
        complaint = lib.exchange_respond(x, row, encoder, accel)
        if complaint == lib.EXCHANGE_TRAVEL:
            raise self._guard.too_far(row, x.moved)
        if complaint == lib.EXCHANGE_SPEED:
            raise self._guard.too_fast(row, x.moved)
        if complaint == lib.EXCHANGE_STALLED:
            raise self._guard.stalled(row, x.command)
        if complaint == lib.EXCHANGE_NO_NUMBER:
            raise self._guard.no_number(row)
        return x.answer

    def record(self, row: int, clock: int, encoder: int, accel: int, command: int, status: int, sent: float,
               received: float, written: float) -> None:
        """Put a row that Python has handled among the others."""
        self._rows[row] = (sent, received, written, clock, encoder, accel, command, status, 1)
        self._lib.exchange_publish(self._x, row)

    def write(self, frame: bytes) -> None:
        """Send a frame, or what is left of it where C has begun to."""
        begun, self._x.begun = self._x.begun, 0
        self._port.write(frame[begun:])

    def begin(self, row: int, received: float, session: int) -> None:
        """Say where Python is: the last row (-1: none) and when the line was last looked at (s)."""
        x = self._x
        x.session, x.received, x.came, x.unanswered, x.begun, x.row = session, received, 0, 0, 0, row

    def run(self, client: Client) -> bool:
        """Let C handle the samples that come, until something is Python's; whether bytes came, or a signal.

        What C has not handled is then in the decoder (``feed(b"")``).  Returns after TIMEOUT without an ordinary
        sample, as a read does.  WorkError: the line was lost.
        """
        x, lib, decoder = self._x, self._lib, client.decoder
        self._port.wake_at(1)
        self._bytes[:len(decoder.rest)] = decoder.rest
        x.taken, x.filled = 0, len(decoder.rest)
        try:
            reason = lib.exchange_run(x, TIMEOUT)
        finally:  # Ctrl-C is raised as C returns
            decoder.rest = self._bytes[x.taken:x.filled]
        if reason == lib.EXCHANGE_LINE:
            data = self._port.read(1)  # raises with its words, or C was mistaken
            decoder.rest += data
            return bool(data)
        if reason == lib.EXCHANGE_SIGNAL:
            self._forward()
        return bool(x.came) or reason != lib.EXCHANGE_QUIET

    @contextmanager
    def serving(self, record: Record, abort: threading.Event) -> Iterator[None]:
        """Around a session: rows go to ``record`` in their order from a thread of its own, ``abort`` takes every sample
        from C, and signals wake it.  What ``record`` raises ends the session; at the latest it is raised here."""
        over = threading.Event()

        def work() -> None:
            try:
                while not over.is_set():
                    (over if abort.is_set() else abort).wait(PERIOD)
                    if abort.is_set():
                        self._lib.exchange_abort(self._x)
                    self._deliver(record)
                self._deliver(record)
            except BaseException as error:
                self.failure = error
                self._lib.exchange_abort(self._x)

        thread = threading.Thread(target=work, name="station-rows", daemon=True)
        thread.start()
        try:
            with self._woken_by_signals():
                yield
        finally:
            over.set()
            thread.join()
        if self.failure is not None:
            raise self.failure

    def _deliver(self, record: Record) -> None:
        begun, end = self._delivered, self._lib.exchange_published(self._x)
        self._delivered = end
        for row, values in enumerate(self._rows[begun:end].tolist(), begun):
            sent, received, written, clock, encoder, accel, command, status, recorded = values
            if recorded:
                record(row, clock, encoder, accel, command, status, sent, received, written)

    @contextmanager
    def _woken_by_signals(self) -> Iterator[None]:
        """Signals come to a pipe that C looks at, whichever thread gets them; Python handles them in the main one."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        reading, writing = os.pipe()
        try:
            os.set_blocking(reading, False)
            os.set_blocking(writing, False)
            before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
            self._wakes, self._x.signals = (reading, before), reading
            try:
                yield
            finally:
                signal.set_wakeup_fd(before)
                self._x.signals = -1
                self._forward()
        finally:
            os.close(reading)
            os.close(writing)

    def _forward(self) -> None:
        """Empty the pipe; who else waits for signals in this way hears of them."""
        reading, before = self._wakes
        with suppress(OSError):
            data = os.read(reading, 4096)
            if before >= 0:
                os.write(before, data)
