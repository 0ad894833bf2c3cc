"""A test on a device, from identify to stop: the reference through the compensator to the motor, every row logged.

Which value acts when: the host answers the sample of tick i with the command for tick i + 1, worked out from the
reference of row i + 1 and the readings of row i (``command_row`` = -1; -k with ``answer_ticks`` = k).  No sample
comes before tick 0, so the command of the first ``answer_ticks`` rows is 0.  The compensator's recursion runs on
its limited output; what is sent is rounded half up.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from station.control.compensators import Compensator
from station.device.client import Client, Identity
from station.device.port import Port
from station.device.protocol import State
from station.errors import UsageError, WorkError
from station.loop.engine import Counts, Session
from station.loop.sink import LogSink
from station.loop.timing import DeviceClock, Spread
from station.rig import Rig
from station.runs.run import RunMetadata

REST_SECONDS = 0.25
"""So long the accelerometer's zero is measured, motor off, before a test."""
SETTLE_SECONDS = 20.0


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
    seconds: float = 0.0


def versions() -> dict[str, str]:
    """The programs that made a run, for its metadata."""
    try:
        station = version("station")
    except PackageNotFoundError:
        station = "checkout"
    return {"station": station, "python": platform.python_version(), "numpy": np.__version__}


def identify_clear(client: Client) -> Identity:
    """Identify the device; clear a fault that an earlier run left."""
    identity = client.identify()
    if identity.state == State.FAULT:
        client.clear()
        identity = client.identify()
    return identity


def connect(client: Client, rig: Rig) -> Identity:
    """Identify the device, clear an old fault, and see that it can run this rig's tests."""
    identity = identify_clear(client)
    if not identity.rate_min - 1e-3 <= rig.sample_rate <= identity.rate_max + 1e-3:
        raise UsageError(f"{client.port.url}: the device runs at {identity.rate_min:g} to {identity.rate_max:g} Hz, "
                         f"rig {rig.name} at sample_rate = {rig.sample_rate:g}")
    return identity


def arm(client: Client, identity: Identity, rate: float, limit: float, answer_ticks: int = 1) -> None:
    """A fresh identify, configure and arm, as each session needs; rate in Hz, limit in counts."""
    again = client.identify()
    if again.boot != identity.boot:
        raise WorkError(f"{client.port.url}: the device was reset meanwhile; start again")
    client.configure(rate, min(math.floor(limit), identity.command_limit), answer_ticks=answer_ticks)
    client.arm()


def measure_rest(client: Client, rig: Rig, identity: Identity, seconds: float = REST_SECONDS) -> Rest:
    """Wait for rest, then read the sensors with a motor that the device's own limit keeps at zero."""
    client.wait_for_rest(SETTLE_SECONDS)
    readings: list[int] = []
    arm(client, identity, rig.sample_rate, limit=0.0)
    rows = max(2, round(seconds * rig.sample_rate))
    Session(client, rows, lambda row, encoder, accel: 0,
            lambda row, clock, encoder, accel, *rest: readings.append(accel)).run()
    accel = np.array(readings, dtype=float)
    sigma = float(np.std(accel, ddof=1)) if len(accel) > 1 else 0.0
    return Rest(float(np.mean(accel)), sigma, client.wait_for_rest(SETTLE_SECONDS))  # a bias may have moved it


def run_test(port: Port, rig: Rig, compensator: Compensator, reference: np.ndarray, *,
             log_sink: Callable[[RunMetadata], LogSink],
             metadata: RunMetadata | Mapping[str, Any] | None = None,
             progress: Callable[[int, int], None] | None = None, accel_zero: float | None = None,
             relative: bool = True, answer_ticks: int = 1) -> LoopResult:
    """Run one test on the device at a port and log it.

    reference: counts, one value per tick, beginning at rest.  With ``relative`` it counts from where the encoder
    rests (open loop: never); the log holds it absolute.  ``accel_zero`` (counts) is measured over 0.25 s at rest
    where not given.  ``log_sink`` makes the log from the completed metadata (``partial(McapLogWriter, path)``);
    it is called once the device has been identified and is at rest, so that a refused test leaves no file.
    ``progress(row, rows)`` is called ten times a second of device time, after a sample is answered.

    Raises WorkError (line lost, device silent, in fault, refusing) and UsageError (the rig does not fit the
    device).  However it ends, Ctrl-C included, the motor is commanded to zero, a stop is sent and the log is closed.
    """
    reference = np.asarray(reference, dtype=float)
    if reference.ndim != 1 or len(reference) < 2 or not np.all(np.isfinite(reference)):
        raise UsageError("reference: at least two finite values in one dimension are wanted")
    client = Client(port)
    identity = connect(client, rig)
    rest = measure_rest(client, rig, identity) if accel_zero is None or relative else Rest()
    if accel_zero is None:
        accel_zero = rest.accel_zero
    if relative and not compensator.open_loop:
        reference = reference + rest.encoder
    compensator.reset(accel_zero)
    arm(client, identity, rig.sample_rate, min(rig.amplifier.limit, compensator.limit), answer_ticks)
    known = metadata.entries() if isinstance(metadata, RunMetadata) else dict(metadata or {})
    completed = RunMetadata.model_validate({
        "rig": rig.model_dump(exclude_none=True), "controller": compensator.spec, "versions": versions(),
        "firmware": identity.summary(), "zero_id": identity.zero_id, "command_row": -answer_ticks,
        "accel_zero": accel_zero, "accel_sigma": rest.accel_sigma, "start": "released", "rounding": True,
        "answer_ticks": answer_ticks, "clock": "virtual" if identity.virtual_time else "real", "port": port.url,
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())} | known)
    sink = log_sink(completed)
    try:
        result = LoopResult(identity, completed, rest, Counts())
        _drive(client, rig, compensator, reference, sink, result, progress, answer_ticks)
    finally:
        sink.close()
    return result


def _drive(client: Client, rig: Rig, compensator: Compensator, reference: np.ndarray, sink: LogSink,
           result: LoopResult, progress: Callable[[int, int], None] | None, answer_ticks: int) -> None:
    rows, rate, period = len(reference), rig.sample_rate, answer_ticks / rig.sample_rate
    wanted = [*reference.tolist(), *[0.0] * answer_ticks]
    last = rows - answer_ticks
    step, append, seconds = compensator.step, sink.append, DeviceClock(result.identity.clock_hz).seconds
    latencies = np.zeros(rows)

    def respond(row: int, encoder: int, accel: int) -> int:
        """The command for tick row + answer_ticks; beyond the last row 0."""
        return math.floor(step(wanted[row + answer_ticks], encoder, accel) + 0.5) if row < last else 0

    def record(row: int, clock: int, encoder: int, accel: int, command: int, status: int, sent: float,
               received: float, written: float) -> None:
        latency = latencies[row] = written - received
        append((row, row / rate, wanted[row], command, encoder, accel, seconds(clock), received, status, sent,
                latency, period - latency))

    tell = None if progress is None else lambda row: progress(row, rows)
    session = Session(client, rows, respond, record, answer_ticks, tell, round(rate / 10.0))
    begun = time.perf_counter()
    try:
        session.run()
    finally:
        result.counts, result.seconds = session.counts, time.perf_counter() - begun
        result.latency = Spread.of(latencies[latencies > 0.0])
        result.metadata = result.metadata.model_copy(update={
            "session": client.last_session, "counts": session.counts.as_dict(), "latency": result.latency.as_dict()})
        sink.update(result.metadata)
