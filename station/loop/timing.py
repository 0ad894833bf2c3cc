"""Figures of the loop's timing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

_EDGES = (0.0, 10e-6, 20e-6, 30e-6, 50e-6, 75e-6, 100e-6, 150e-6, 200e-6, 300e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3,
          20e-3, 50e-3)
"""Edges of a histogram's bins, s; beyond the last one is one more bin."""


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


@dataclass(frozen=True)
class Histogram:
    """How many times lie from each edge (s) up to the next, the last beyond its edge."""

    edges: tuple[float, ...]
    counts: tuple[int, ...]

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray) -> Histogram:
        """Of times, s, not negative."""
        counts, _ = np.histogram(values, bins=[*_EDGES, np.inf])
        return cls(_EDGES, tuple(int(count) for count in counts))

    def as_dict(self) -> dict[str, list[float]]:
        """For metadata and JSON."""
        return {"edges": list(self.edges), "counts": list(self.counts)}

    def lines(self, width: int = 40) -> list[str]:
        """A drawing for people: one line per bin that holds something or lies between such."""
        filled = [i for i, count in enumerate(self.counts) if count]
        if not filled:
            return []
        most, total = max(self.counts), sum(self.counts)
        lines = []
        for i in range(filled[0], filled[-1] + 1):
            low = 1e6 * self.edges[i]
            upper = f"{1e6 * self.edges[i + 1]:6.0f}" if i + 1 < len(self.edges) else "   ..."
            bar = "#" * max(round(width * self.counts[i] / most), 1 if self.counts[i] else 0)
            lines.append(f"{low:6.0f} to {upper} us {self.counts[i]:8d} {100.0 * self.counts[i] / total:7.3f} % {bar}")
        return lines
