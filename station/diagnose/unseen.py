"""What a fitted set of causes says of runs left out, to first order: for tables of many sets, where refits take long.

Leaving run r out moves the fit by d_r = (sum_{s != r} A_s/T + P)^-1 (sum_{s != r} g_s/T - P (x - m)), with A_s and g_s
the run's normal matrix and gradient, its nuisances eliminated, T the scale of the noise, P and m the prior.  The run's
chi^2 there is c_r - 2 g_r d_r + d_r A_r d_r, its own nuisances fitted (Belsley, Kuh and Welsch 1980, ch. 2).
"""

from __future__ import annotations

import math

import numpy as np

from station.diagnose.estimate import Fit


def left_out_chi2(found: Fit, temperature: float = 1.0) -> float:
    """Sum over runs of the chi^2 of each by a fit that left it out."""
    layout = found.layout
    pull = layout.prior_precision * (found.x - layout.prior_mean)
    total = 0.0
    for r, (own, slope) in enumerate(zip(found.normal, found.gradient, strict=True)):
        matrix = (found.normal.sum(axis=0) - own) / temperature + np.diag(layout.prior_precision)
        moved = np.linalg.solve(matrix, (found.gradient.sum(axis=0) - slope) / temperature - pull)
        total += float(found.costs[r].sum() + found.penalty[r] - 2.0 * slope @ moved + moved @ own @ moved)
    return total


def unseen_gain(nothing: Fit, found: Fit, temperature: float = 1.0) -> float:
    """By how much a set of causes lowers the error of unseen runs, against the re-fitted rig; a share of that error."""
    before = left_out_chi2(nothing, temperature)
    return 1.0 - math.sqrt(max(left_out_chi2(found, temperature), 0.0) / before) if before > 0.0 else 0.0
