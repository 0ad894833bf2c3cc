"""What runs say of how much the motor does more in each than the rig says: a Gaussian, all else integrated out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.estimation.likelihood import differ_precision
from station.rig import Rig


@dataclass(frozen=True, eq=False)
class Differing:
    """What runs say of what each does more than the rig, a share of the command and a constant, run by run (2 runs)."""

    rig: Rig
    precision: np.ndarray
    """(2 runs, 2 runs) of the data."""
    force: np.ndarray
    """(2 runs) the data's slope where the fit has them."""
    away: np.ndarray
    """(2 runs) how far from their priors' means that is."""

    def _at(self, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(...) marginal log likelihood, up to a constant, of ``sizes`` (..., 2), and there the posterior's covariance
        (..., 2 runs, 2 runs) and how far it moves them from the fit (..., 2 runs)."""
        own = np.tile(differ_precision(self.rig, sizes), len(self.away) // 2)
        covariance = np.linalg.inv(self.precision + own[..., None] * np.eye(len(self.away)))
        force = self.force - own * self.away
        moved = (covariance @ force[..., None])[..., 0]
        volume = np.log(own).sum(axis=-1) + np.linalg.slogdet(covariance)[1]
        return 0.5 * (volume + (force * moved).sum(axis=-1) - own @ self.away**2), covariance, moved

    def log_likelihoods(self, sizes: np.ndarray) -> np.ndarray:
        """(...) marginal, up to a constant, of ``sizes`` (..., 2)."""
        return self._at(sizes)[0]

    def surprise(self, logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus twice ``log_likelihoods``, and its slope (2), at the logarithms of sizes (2).

        The slope follows from the runs' squares and what these leave uncertain (the identity behind expectation and
        maximisation: Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977); these rounds themselves take hundreds to
        arrive where runs are alike.
        """
        sizes = np.exp(logs)
        value, covariance, moved = self._at(sizes)
        squares = ((self.away + moved) ** 2 + covariance.diagonal()).reshape(-1, 2)
        return float(-2.0 * value), 2.0 * (len(squares) - squares.sum(axis=0) / sizes**2)
