"""The three clocks of a test, kept apart by name, and every conversion between them.

====================  ==============================================================================================
``device_ticks``      the board's own counter, 32 bits, ``clock_hz`` per second; it wraps
``device_time``       the same in s since the session's first sample (``DeviceClock``)
``host_time``         this machine's monotonic clock, s (``time.perf_counter``; its zero means nothing)
``wall_time``         date and time, for people and file names alone (``HostClock``)
====================  ==============================================================================================

Intervals are differences of one clock; two clocks meet in ``pace`` (device and host) and ``HostClock`` (host and
wall) alone.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime

import numpy as np

_MASK32 = 0xFFFFFFFF


class DeviceClock:
    """Turns a board's 32-bit clock into seconds since the session's first sample, across its wraps."""

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self._last: int | None = None
        self._counts = 0

    def seconds(self, device_ticks: int) -> float:
        """Seconds since the first call."""
        if self._last is not None:
            self._counts += (device_ticks - self._last) & _MASK32
        self._last = device_ticks
        return self._counts / self._hz


@dataclass(frozen=True)
class HostClock:
    """One instant read on both the host's and the wall's clock: a wall that is set meanwhile moves no row."""

    host_time: float = field(default_factory=time.perf_counter)
    wall_time: float = field(default_factory=time.time)

    def wall(self, host_time: float) -> datetime:
        """Date and time (UTC) of an instant of the host's clock."""
        return datetime.fromtimestamp(self.wall_time + host_time - self.host_time, UTC)


@dataclass(frozen=True)
class Pace:
    """Device seconds that pass in one second of the host, and how sure that is (one sigma)."""

    ratio: float
    sigma: float

    def as_dict(self) -> dict[str, float]:
        """For metadata and JSON."""
        return asdict(self)


def pace(device_time: np.ndarray, host_time: np.ndarray) -> Pace | None:
    """How fast the device's clock runs against the host's, both in s, row by row; None for fewer than 20 rows.

    A sample is received late, never early.  The rows are cut into ten stretches; the row of each that came with the
    least delay stands for it, and a line through these is the pace (least squares).
    """
    rows = len(device_time)
    if rows < 20:
        return None
    device, host = device_time - device_time[0], host_time - host_time[0]
    if not (device[-1] > 0.0 and host[-1] > 0.0):
        return None
    delay = host - device * (host[-1] / device[-1])
    best = np.array([part[np.argmin(delay[part])] for part in np.array_split(np.arange(rows), 10)])
    x, y = host[best], device[best]
    design = np.column_stack((x, np.ones_like(x)))
    (slope, offset), *_ = np.linalg.lstsq(design, y, rcond=None)
    left = y - design @ (slope, offset)
    spread = float(np.sum((x - x.mean()) ** 2))
    sigma = math.sqrt(float(left @ left) / (len(x) - 2) / spread) if spread else math.inf
    return Pace(float(slope), sigma)
