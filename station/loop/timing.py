"""Figures of the loop's timing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

_MASK32 = 0xFFFFFFFF


class DeviceClock:
    """Turns a board's 32-bit clock into seconds since the session's first sample, across its wraps."""

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self._last: int | None = None
        self._counts = 0

    def seconds(self, clock: int) -> float:
        """Seconds since the first call."""
        if self._last is not None:
            self._counts += (clock - self._last) & _MASK32
        self._last = clock
        return self._counts / self._hz


@dataclass(frozen=True)
class Spread:
    """Percentiles of a time, s."""

    median: float
    p99: float
    p999: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray) -> Spread:
        """Of at least one value; all zero where there is none."""
        if not len(values):
            return cls(0.0, 0.0, 0.0, 0.0)
        median, p99, p999 = (float(v) for v in np.percentile(values, (50.0, 99.0, 99.9)))
        return cls(median, p99, p999, float(np.max(values)))

    def as_dict(self) -> dict[str, float]:
        """For metadata and JSON."""
        return asdict(self)
