"""What hypotheses predict of tests that have not been run, and what a refit would absorb of a difference.

A hypothesis' constants and sizes are uncertain, so that its prediction is Gaussian with covariance S = I + J C J', in
units of the noise, C the posterior of its fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from station.estimation.likelihood import NUISANCES
from station.model.simulate import Model


@dataclass(frozen=True)
class Belief:
    """One hypothesis as its data leave it: ``model(x)`` builds its rig; the columns of ``axes`` (p, k) are one
    posterior sigma along each direction that is open."""

    words: str
    x: np.ndarray
    axes: np.ndarray
    model: Callable[[np.ndarray], Model]

    @property
    def still(self) -> Belief:
        """The same as if nothing were uncertain: its forecasts cost one simulation each."""
        return replace(self, axes=np.zeros((len(self.x), 0)))


@dataclass(frozen=True)
class Forecast:
    """What a hypothesis predicts of one trial, counts: ``mean`` (channels, n), ``spread`` (k, channels, n)."""

    mean: np.ndarray
    spread: np.ndarray
    command: np.ndarray


def nuisance_rows(scale: np.ndarray) -> np.ndarray:
    """Rows (channels, channels n) of what starting angle and offset may do, scaled by ``scale`` (channels, n)."""
    return block_diag(*(sigma * weights for sigma, weights in zip(NUISANCES, scale, strict=False)))


def absorbed(change: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """change (m, n), or one row, times S^-1 = (I + spread' spread)^-1, ``spread`` (k, n): what no refit takes up."""
    inner = np.eye(len(spread)) + spread @ spread.T
    return change - (np.linalg.solve(inner, spread @ change.T)).T @ spread
