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
from station.estimation.prediction import SEARCH
from station.model.effects import Stage
from station.model.simulate import Model, build
from station.rig import Rig


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


def built(rig: Rig) -> Model:
    """A rig's model, as fine as the search simulates it."""
    gap = any(effect.stage is Stage.GAP for effect in rig.effects)
    return build(rig, SEARCH[0], SEARCH[2] if gap else SEARCH[1])
