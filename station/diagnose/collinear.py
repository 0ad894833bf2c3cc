"""Causes that do the same to these runs: the one is told from the other by nothing that was measured.

With y what a set of causes predicts, y' what it predicts with another cause in the place of one of its own, y0 what it
does without it, each fitted, and |.| the norm in which the likelihood weighs errors, the share

    |y - y'|^2/|y - y0|^2

of what the one changes is not done by the other.  It is the tolerance 1 - R^2 of two regressors (Belsley, Kuh and
Welsch, Regression Diagnostics, 1980, section 3.1), after all constants have done what they can.
"""

from __future__ import annotations

import numpy as np

from station.diagnose.selection import Selection
from station.diagnose.thresholds import TOLERANCE
from station.estimation.cause import Causes, Key
from station.estimation.fitted import Fit


def collinear(search: Selection, best: Causes, cause: Key) -> frozenset[Key]:
    """The causes that, in the place of one of the best set's, do the same."""
    rest, found = best - {cause}, search.fits[best]
    if rest not in search.fits:
        return frozenset()
    done = _distance(search, found, search.fits[rest])
    others = [keys for keys in search.fits if len(keys) == len(best) and rest < keys and keys != best]
    return frozenset(key for keys in others if _distance(search, found, search.fits[keys]) < TOLERANCE * done
                     for key in keys - rest)


def _distance(search: Selection, one: Fit, other: Fit) -> float:
    """Squared, of what two fits predict."""
    weights = one.blocks(search.compared)
    return sum(float(w @ np.sum(((a - b) * search.predictor.scale(r)) ** 2, axis=1))
               for r, (w, a, b) in enumerate(zip(weights, one.predicted, other.predicted, strict=True)))
