"""A test on a device, from identify to stop: the reference through the compensator to the motor, every row logged.

Which value acts when: the host answers the sample of tick i with the command for tick i + 1, worked out from the
reference of row i + 1 and the readings of row i (``command_row`` = -1; -k with ``answer_ticks`` = k).  No sample
comes before tick 0, so the command of the first ``answer_ticks`` rows is 0.  The compensator's recursion runs on
its limited output; what is sent is rounded half up.
"""

from __future__ import annotations

import copy
import math
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from types import FrameType
from typing import Any

import numpy as np

from station.control.compensators import Compensator
from station.device.client import Client, Identity
from station.device.limits import DeviceLimits
from station.device.line import MOST_ANSWER_TICKS, Line
from station.device.port import Port
from station.device.protocol import State
from station.errors import UsageError
from station.loop import checked
from station.loop.clocks import DeviceClock, HostClock, Pace, pace
from station.loop.display import watched
from station.loop.engine import Counts, Session, Setup
from station.loop.exchange import COMPILED, INTERPRETED, Exchange, sample_path
from station.loop.realtime import Realtime, undisturbed_thread
from station.loop.safety import (
    Guard,
    clipped_rows,
    require_rest,
    require_small_first_command,
    require_within_limits,
)
from station.loop.sink import LogSink
from station.loop.timing import Histogram, Spread
from station.rig import Rig
from station.runs.run import RunMetadata

REST_SECONDS = 0.25
"""So long the accelerometer's zero is measured, motor off, before a test."""
SETTLE_SECONDS = 20.0
HANGS = 3.0
"""Seconds after which Ctrl-C no longer waits for a log to be closed."""


@dataclass(frozen=True)
class Rest:
    """The rig at rest: mean and standard deviation of the accelerometer, the encoder's reading (counts)."""

    accel_zero: float = 0.0
    accel_sigma: float = 0.0
    encoder: int = 0


@dataclass
class LoopResult:
    """What a test left behind besides its rows; times in s."""

    identity: Identity
    metadata: RunMetadata
    rest: Rest
    counts: Counts
    latency: Spread = field(default_factory=lambda: Spread.of([]))
    slack: Spread = field(default_factory=lambda: Spread.of([]))
    histogram: Histogram = field(default_factory=lambda: Histogram.of([]))
    pace: Pace | None = None
    realtime: Realtime | None = None
    seconds: float = 0.0
    clipped: int = 0
    """Rows of an open-loop test whose command was cut to the limit."""
    sample_path: str = INTERPRETED
    """What answered the ordinary samples: ``compiled``, or ``python``, with the reason where C was wanted."""


def versions() -> dict[str, str]:
    """The programs that made a run, for its metadata."""
    try:
        station = version("station")
    except PackageNotFoundError:
        station = "checkout"
    return {"station": station, "python": platform.python_version(), "numpy": np.__version__,
            "scipy": version("scipy"), "numba": version("numba"), "pyserial": version("pyserial"),
            "system": platform.platform()}


def coefficients(compensator: Compensator) -> dict[str, list[float]]:
    """The difference equation as it ran, in z, highest power first: what a specification comes to at this rate."""
    names = ("numerator", "denominator", "accel_numerator", "accel_denominator")
    return {name: getattr(compensator, name).tolist() for name in names if getattr(compensator, name).size}


def identify_clear(client: Client) -> Identity:
    """Identify the device; clear a fault that an earlier run left."""
    identity = client.identify()
    if identity.state == State.FAULT:
        client.clear()
        identity = client.identify()
    return identity


def connect(client: Client, rig: Rig, answer_ticks: int) -> Identity:
    """Identify the device, clear an old fault, and see that it and its line can run this rig's tests."""
    identity = identify_clear(client)
    if not identity.rate_min - 1e-3 <= rig.sample_rate <= identity.rate_max + 1e-3:
        raise UsageError(f"{client.port.url}: the device runs at {identity.rates}, "
                         f"rig {rig.name} at sample_rate = {rig.sample_rate:g}")
    Line.of(client.port, identity).require(client.port.url, rig.sample_rate, answer_ticks)
    return identity


def rest_position(port: Port, rig: Rig, settle: float = 0.0) -> tuple[str, int]:
    """Let ``settle`` seconds pass and the arm come to rest; the encoder's zero by name, and its reading (counts)."""
    client = Client(port)
    identity = connect(client, rig, MOST_ANSWER_TICKS)
    if settle:
        client.wait(settle)
    return identity.zero_id, client.wait_for_rest(SETTLE_SECONDS)


def measure_rest(client: Client, rig: Rig, identity: Identity, answer_ticks: int = 1,
                 seconds: float = REST_SECONDS) -> Rest:
    """Wait for rest, then read the sensors with a motor that the device's own limit keeps at zero."""
    client.wait_for_rest(SETTLE_SECONDS)
    readings: list[int] = []
    rows = max(2, round(seconds * rig.sample_rate))
    setup = Setup(identity, rig.sample_rate, 0.0, answer_ticks, DeviceLimits.of_rig(rig))
    Session(client, setup, rows, lambda row, encoder, accel: 0,
            lambda row, clock, encoder, accel, *rest: readings.append(accel)).run()
    accel = np.array(readings, dtype=float)
    sigma = float(np.std(accel, ddof=1)) if len(accel) > 1 else 0.0
    return Rest(float(np.mean(accel)), sigma, client.wait_for_rest(SETTLE_SECONDS))  # a bias may have moved it


def run_test(port: Port, rig: Rig, compensator: Compensator, reference: np.ndarray, *,
             log_sink: Callable[[RunMetadata], LogSink],
             metadata: RunMetadata | Mapping[str, Any] | None = None,
             progress: Callable[[int, int], None] | None = None, accel_zero: float | None = None,
             relative: bool = True, answer_ticks: int = 1, abort: threading.Event | None = None,
             realtime: bool = False, force: bool = False) -> LoopResult:
    """Run one test on the device at a port and log it.

    reference: counts, one value per tick, beginning with at least 0.2 s at rest.  With ``relative`` it counts from
    where the encoder rests (open loop: never); the log holds it absolute.  ``accel_zero`` (counts) is measured over
    0.25 s at rest where not given.  ``log_sink`` makes the log from the completed metadata
    (``partial(McapLogWriter, path)``); it is called once the device has been identified and is at rest, and before it
    is armed, so that a refused test leaves no file and a log that cannot be made arms nothing.
    ``progress(row, rows)`` is called about ten times a second from another thread; what it does or raises never
    touches the loop.  ``abort``: once set, the motor is at zero within one tick and KeyboardInterrupt is raised; where
    it is set before the log is made, no motor is driven.
    ``realtime`` asks the system for a thread that is not disturbed (``station.loop.realtime``); what was got stands
    in the metadata.  ``force`` runs a closed loop without a passed check of this device and rig, and is logged.

    Raises WorkError (line lost, device silent, in fault, refusing) and UsageError (the rig does not fit the device, its
    rate not the line under ``answer_ticks``, no passed check, a reference that does not begin at rest).  However it
    ends, Ctrl-C included, the motor is commanded to zero, a stop is sent and the log is closed; the metadata's
    ``outcome`` says why it ended.
    """
    reference = np.asarray(reference, dtype=float)
    if reference.ndim != 1 or len(reference) < 2 or not np.all(np.isfinite(reference)):
        raise UsageError("reference: at least two finite values in one dimension are wanted")
    require_rest(reference, rig.sample_rate, compensator.open_loop)
    require_within_limits(rig, reference, compensator.open_loop)
    client = Client(port)
    identity = connect(client, rig, answer_ticks)
    check = None if compensator.open_loop else checked.require(port.url, identity, rig, force)
    if accel_zero is None or relative:
        rest = measure_rest(client, rig, identity, answer_ticks)
    else:
        rest = Rest(accel_zero, 0.0, client.wait_for_rest(SETTLE_SECONDS))
    if accel_zero is None:
        accel_zero = rest.accel_zero
    if relative and not compensator.open_loop:
        reference = reference + rest.encoder
    limit = math.floor(min(rig.command_limit, compensator.limit, identity.command_limit))
    compensator = copy.copy(compensator)
    compensator.limit = limit  # it works on with what acts, not with what the device would cut
    require_small_first_command(port.url, rig.sample_rate, compensator, reference[0], rest.encoder, accel_zero)
    compensator.reset(accel_zero)
    path = sample_path(port, compensator)
    clock = HostClock()
    known = metadata.entries() if isinstance(metadata, RunMetadata) else dict(metadata or {})
    completed = RunMetadata.model_validate({
        "rig": rig.model_dump(exclude_none=True), "controller": compensator.spec,
        "coefficients": coefficients(compensator), "versions": versions(),
        "firmware": identity.summary(), "zero_id": identity.zero_id, "command_row": -answer_ticks,
        "accel_zero": accel_zero, "accel_sigma": rest.accel_sigma, "start": "released", "rounding": True,
        "answer_ticks": answer_ticks, "clock": "virtual" if identity.virtual_time else "real", "port": port.url,
        "command_limit": limit, "check": check, "began": clock.wall(clock.host_time).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "host_time_began": clock.host_time, "sample_path": path, "outcome": "running"} | known)
    setup = Setup(identity, rig.sample_rate, limit, answer_ticks, DeviceLimits.of_rig(rig))
    if abort is not None and abort.is_set():
        raise KeyboardInterrupt
    with _ctrl_c() as ending:
        sink = log_sink(completed)
        try:
            result = LoopResult(identity, completed, rest, Counts(), sample_path=path,
                                clipped=clipped_rows(reference, limit, compensator.open_loop))
            _drive(client, setup, compensator, reference, sink, result, progress, abort, realtime, ending)
        finally:
            ending.begun = True
            sink.close()
    return result


@dataclass
class _Ending:
    """Whether a test has begun to end, and when Ctrl-C came first since then (monotonic s, 0: not yet)."""

    begun: bool = False
    late: float = 0.0


@contextmanager
def _ctrl_c() -> Iterator[_Ending]:
    """Ctrl-C as ever; but once the test has begun to end it waits until the log is closed, lest that be left half done.

    Should the end hang, one that comes HANGS seconds after the first is raised where it comes.
    """
    ending, before = _Ending(), signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield ending
        return

    def handle(number: int, frame: FrameType | None) -> None:
        if ending.begun:
            ending.late = ending.late or time.monotonic()
            if time.monotonic() - ending.late < HANGS:
                return
        before(number, frame)

    signal.signal(signal.SIGINT, handle)
    try:
        yield ending
    finally:
        signal.signal(signal.SIGINT, before)
    if ending.late:
        before(signal.SIGINT, None)


def _outcome(error: BaseException | None) -> str:
    """Why a test ended, for its metadata: ``complete``, ``interrupted``, or the failure's own words."""
    if error is None:
        return "complete"
    return "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__


def _drive(client: Client, setup: Setup, compensator: Compensator, reference: np.ndarray, sink: LogSink,
           result: LoopResult, progress: Callable[[int, int], None] | None, abort: threading.Event | None,
           realtime: bool, ending: _Ending) -> None:
    rows, rate, answer_ticks = len(reference), setup.rate, setup.answer_ticks
    period = answer_ticks / rate
    wanted = [*reference.tolist(), *[0.0] * answer_ticks]
    last = rows - answer_ticks
    step, append, seconds = compensator.step, sink.append, DeviceClock(result.identity.clock_hz).seconds
    latencies, device_times, host_times = np.zeros(rows), np.zeros(rows), np.zeros(rows)

    guard = Guard(client.port.url, setup.limits.within(setup.identity.limits), result.rest.encoder, setup.limit, rate)
    drive, limited = guard.drive, guard.limited

    def respond(row: int, encoder: int, accel: int) -> int:
        """The command for tick row + answer_ticks; beyond the last row 0."""
        if limited:
            guard.see(row, encoder)
        if row >= last:
            return 0
        command = step(wanted[row + answer_ticks], encoder, accel)
        drive(row, encoder, command)
        return math.floor(command + 0.5)

    def record(row: int, device_ticks: int, encoder: int, accel: int, command: int, status: int, sent: float,
               received: float, written: float) -> None:
        latency = latencies[row] = written - received
        device_time = device_times[row] = seconds(device_ticks)
        host_times[row] = received
        append((row, row / rate, wanted[row], command, encoder, accel, device_time, received, status, sent,
                latency, period - latency))

    abort = abort or threading.Event()
    exchange = None
    if result.sample_path == COMPILED:
        exchange = Exchange(client.port, compensator, guard, reference, answer_ticks)
        session = Session(client, setup, rows, exchange.respond, exchange.record, abort, exchange)
    else:
        session = Session(client, setup, rows, respond, record, abort)
    begun = time.perf_counter()
    failure: BaseException | None = None
    try:
        with np.errstate(over="ignore", invalid="ignore"), \
                watched(session, None if progress is None else lambda row: progress(row, rows)), \
                nullcontext() if exchange is None else exchange.serving(record, abort), \
                undisturbed_thread(realtime, exchange is not None, client.port.is_terminal) as got:
            result.realtime = got
            session.run()
    except BaseException as error:
        failure = error
        raise
    finally:
        ending.begun = True
        result.counts, result.seconds = session.counts, time.perf_counter() - begun
        seen = latencies[latencies > 0.0]
        result.latency, result.histogram = Spread.of(seen), Histogram.of(seen)
        result.slack = Spread.of(period - seen) if len(seen) else Spread.of([])
        if client.paced:
            came = host_times > 0.0
            result.pace = pace(device_times[came], host_times[came])
        result.metadata = result.metadata.model_copy(update={
            "session": client.last_session, "counts": session.counts.as_dict(), "latency": result.latency.as_dict(),
            "histogram": result.histogram.as_dict(), "outcome": _outcome(failure), "clipped_rows": result.clipped,
            "realtime": None if result.realtime is None else result.realtime.as_dict(),
            "pace": None if result.pace is None else result.pace.as_dict()})
        sink.update(result.metadata)
