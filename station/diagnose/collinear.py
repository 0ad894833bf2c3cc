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
    """The causes that, in the place of one of the best set's, do the same: beside all its others or, where that was not
    fitted, beside the most of them with which it was."""
    others = frozenset(key for keys in search.fits for key in keys) - best
    return frozenset(key for key in others if _alike(search, best, cause, key))


def _alike(search: Selection, best: Causes, cause: Key, other: Key) -> bool:
    """Whether one does what the other does, beside as much of the rest of a set as both were fitted with."""
    fits = search.fits
    fitted = [rest for rest in fits if rest <= best - {cause} and {rest | {cause}, rest | {other}} <= fits.keys()]
    if not fitted:
        return False
    beside = max(fitted, key=lambda rest: (len(rest), sorted(rest)))
    mine, its, without = (fits[keys] for keys in (beside | {cause}, beside | {other}, beside))
    return _distance(search, mine, its) < TOLERANCE * _distance(search, mine, without)


def _distance(search: Selection, one: Fit, other: Fit) -> float:
    """Squared, of what two fits predict."""
    weights = one.blocks(search.compared)
    return sum(float(w @ np.sum(((a - b) * search.predictor.scale(r)) ** 2, axis=1))
               for r, (w, a, b) in enumerate(zip(weights, one.predicted, other.predicted, strict=True)))
