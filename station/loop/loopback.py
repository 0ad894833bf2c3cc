"""Loopback: a line and its device judged without moving the motor (the device's own limit is set to zero)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.device.client import Client, Identity
from station.device.line import Line
from station.device.port import Port
from station.device.protocol import Status
from station.errors import UsageError, WorkError
from station.loop.clocks import DeviceClock, Pace, pace
from station.loop.display import watched
from station.loop.engine import Counts, Session, Setup
from station.loop.remedies import explained, latency_words
from station.loop.run_test import identify_clear
from station.loop.timing import Histogram, Spread

_LATENCY_TIMER = 0.004
"""Samples that come in bursts at least so far apart (s) point to an adapter's latency timer."""
_CLOCK_OFF = 1e-3
"""Share by which a device's clock may differ from this machine's unsaid."""


@dataclass(frozen=True)
class LoopbackResult:
    """Figures of a line; times in s, rates in Hz.

    rate_measured: ticks per second of the host's clock (None where the device's time is virtual).
    answered: share of the ticks whose command came in time.  latency: receipt of a sample to its answer written, and
    its histogram.  pace: of the device's clock against the host's (None: virtual, or too short).
    device_jitter: deviation of the device's ticks from their period on its own clock.  arrival_jitter: the same on
    the host's clock.  verdict: what it comes to, in words; ok: whether a test may be run on this line.
    """

    identity: Identity
    rate: float
    rate_measured: float | None
    counts: Counts
    answered: float
    latency: Spread
    histogram: Histogram
    pace: Pace | None
    device_jitter: Spread
    arrival_jitter: Spread
    ok: bool
    verdict: tuple[str, ...]


def loopback(port: Port, rate: float | None = None, seconds: float = 2.0, answer_ticks: int = 1,
             progress: Callable[[int, int], None] | None = None) -> LoopbackResult:
    """Exchange samples and commands for some seconds of device time; ``rate`` is by default the highest that device
    and line offer under ``answer_ticks``.  ``progress`` is told the row and their number, beside the sample path.

    WorkError where no device answers or the line breaks; a device that goes into fault because answers come too
    late is a verdict, not an error.
    """
    client = Client(port)
    try:
        identity = identify_clear(client)
    except WorkError as error:
        raise explained(port, error) from None
    line = Line.of(port, identity)
    if rate is None:
        rate = max(min(identity.rate_max, line.highest_rate(answer_ticks)), identity.rate_min)
    if not identity.rate_min - 1e-3 <= rate <= identity.rate_max + 1e-3:
        raise UsageError(f"{port.url}: the device runs at {identity.rates}, not at {rate:g}")
    line.require(port.url, rate, answer_ticks)
    rows: list[tuple[int, float, int, float, float]] = []
    clock = DeviceClock(identity.clock_hz)

    def record(row: int, ticks: int, encoder: int, accel: int, command: int, status: int, sent: float,
               received: float, written: float) -> None:
        rows.append((row, clock.seconds(ticks), status, received, written))

    wanted = max(round(seconds * rate), 2)
    session = Session(client, Setup(identity, rate, 0.0, answer_ticks), wanted, lambda row, encoder, accel: 0, record)
    fault = None
    try:
        with watched(session, None if progress is None else lambda row: progress(row, wanted)):
            session.run()
    except WorkError as error:
        if "in fault" not in str(error):
            raise
        fault = "the device went into fault: it had no answer in time on too many ticks in a row"
    if len(rows) < 2:
        raise WorkError(f"{port.url}: {len(rows)} samples came; the line does not carry a test at {rate:g} Hz")
    return _judge(port.url, identity, rate, session.counts, np.array(rows), fault)


def _judge(url: str, identity: Identity, rate: float, counts: Counts, rows: np.ndarray,
           fault: str | None) -> LoopbackResult:
    index, device, status, received, written = rows.T
    nominal = np.diff(index) / rate
    unanswered = float(np.mean((status.astype(int) & (Status.HELD | Status.ZEROED)) != 0))
    gaps = np.diff(received)
    measured = None if identity.virtual_time else float(np.polyfit(received, index, 1)[0])
    clocks = None if identity.virtual_time else pace(device, received)
    verdict = [fault] if fault else []
    if counts.lost or counts.corrupt or counts.duplicated or max(counts.device_corrupt, 0):
        verdict.append(f"the line is not clean: {counts.lost} samples lost, {counts.corrupt} corrupt, "
                       f"{counts.duplicated} duplicated; the device had {max(counts.device_corrupt, 0)} corrupt frames")
    if not identity.virtual_time and np.max(gaps) > _LATENCY_TIMER and np.median(gaps) < 0.1 / rate:
        verdict.append(latency_words(url, float(np.max(gaps))))
    if unanswered > 0.0:
        verdict.append(f"{100.0 * unanswered:.2g} % of the ticks had no command in time")
    if counts.woke_late > 0.01 * len(rows):
        verdict.append(f"the device itself began {counts.woke_late} ticks late")
    if clocks is not None and abs(clocks.ratio - 1.0) > max(_CLOCK_OFF, 5.0 * clocks.sigma):
        verdict.append(f"the device's clock runs at {clocks.ratio:.5f} of this machine's: its rate is "
                       f"{rate * clocks.ratio:.2f} Hz, not {rate:g}; see its crystal and the rate it was built for, or "
                       "let the diagnosis find clock_scale")
    ok = fault is None and unanswered <= 0.01 and counts.lost + counts.corrupt <= 0.001 * len(rows)
    if not verdict:
        verdict.append("the line is clean and every tick had its command in time")
    return LoopbackResult(identity, rate, measured, counts, 1.0 - unanswered,
                          Spread.of((written - received)[:-1]), Histogram.of((written - received)[:-1]), clocks,
                          Spread.of(np.abs(np.diff(device) - nominal)),
                          Spread.of(np.abs(gaps - nominal)), ok, tuple(verdict))
