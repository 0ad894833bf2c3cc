"""What a fit leaves, held against what noise would leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.diagnose.estimate import Fit
from station.diagnose.problem import Problem


@dataclass(frozen=True)
class Remainder:
    """What a fit leaves, per run and channel, against what noise would leave."""

    size: np.ndarray
    """(runs, channels) z-score of the mean square."""
    slow: np.ndarray
    """(runs, channels) z-score of the mean square of sums over SPAN samples: structure, not noise."""

    @property
    def is_noise(self) -> bool:
        """Whether nothing stands out."""
        return bool(self.size.max() < 6.0 and self.slow.max() < 6.0)


SPAN = 25
"""Samples."""


def remainder(problem: Problem, found: Fit) -> Remainder:
    """Judge the residuals of a fit.

    Errors count by their share.  A sum over SPAN samples has the variance SPAN where errors last 1/share < SPAN
    samples, and (sum sqrt(share))^2 where one error lasts all through.
    """
    size, slow = [], []
    for scaled, share, temper in zip(found.residuals, problem.share, problem.temper, strict=True):
        e = scaled * np.sqrt(temper)[:, None]
        independent = np.maximum(share.sum(axis=1), 1e-9)
        spread = np.sqrt(3.0 / independent + 3.0 / problem.noise_rows)
        size.append((np.sum(e * e, axis=1) / independent - 1.0) / spread)
        rows = e.shape[1] // SPAN * SPAN
        sums = e[:, :rows].reshape(len(e), -1, SPAN).sum(axis=2) ** 2
        expected = np.minimum(np.sqrt(share[:, :rows]).reshape(len(e), -1, SPAN).sum(axis=2) ** 2, SPAN)
        ratio = sums.sum(axis=1) - expected.sum(axis=1)
        slow.append(ratio / np.sqrt(np.maximum(3.0 * np.sum(expected**2, axis=1), 1e-9)))
    return Remainder(np.array(size), np.array(slow))
