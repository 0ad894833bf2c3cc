"""What a fitted set of causes says of runs left out.

To first order, for tables of many sets, where refits take long: leaving run r out moves the fit by d_r =
(sum_{s != r} A_s/T + P)^-1 (sum_{s != r} g_s/T - P (x - m)), with A_s and g_s the run's normal matrix and gradient,
its nuisances eliminated, T the scale of the noise, P and m the prior.  The run's chi^2 there is
c_r - 2 g_r d_r + d_r A_r d_r, its own nuisances fitted (Belsley, Kuh and Welsch 1980, ch. 2).

By fits that do leave a run out, where causes are held against their absence: the density of the run, its uncertain
values integrated out.  With L = sum_{s != r} A_s/T + P, -2 log p_r = c_r/T - g_r' (A_r/T + L)^-1 g_r/T^2 +
log det(1 + L^-1 A_r/T) up to a constant (Bishop 2006, eq. 3.57, linearised).  A cause that one run alone shows is no
worse for what the others leave open; one that they are sure of, and are wrong about, is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from station.diagnose.estimate import Fit
from station.model.effects import Stage

REFUTED = 12.0
"""-2 log of the odds that one unseen run gives against a cause from which on the runs must agree in its favour.  Of a
cause that is there a run says so much less often than once in 400: the odds p_0/p_1 have the mean 1 under p_1
(Markov's inequality)."""
ALONE = 40.0
"""-2 log of the odds that unseen runs together give for an effect, from which on one of them may be alone in it: what
rounding leaves in one run can look like a small effect."""


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


def surprise(left: Fit, run: int, temperature: float = 1.0) -> float:
    """-2 log density of a run by a fit that left it out, up to a constant."""
    own, slope = left.normal[run] / temperature, left.gradient[run] / temperature
    known = (left.normal.sum(axis=0) - left.normal[run]) / temperature + np.diag(left.layout.prior_precision)
    cost = float(left.costs[run].sum() + left.penalty[run]) / temperature
    opened = np.linalg.slogdet(np.eye(len(own)) + np.linalg.solve(known, own))[1]
    return cost - float(slope @ np.linalg.solve(own + known, slope)) + float(opened)


def refuted(without: Sequence[Fit], found: Sequence[Fit], temperature: float = 1.0) -> bool:
    """Whether unseen runs speak against a cause; ``without`` it and with it, fits that leave out run after run.

    What they gain together must exceed their scatter, unless it is much and no run speaks against it.  What tells of a
    constant is the rig file as well, and of the clock a second clock: there one run must clearly be against it.
    """
    gains = np.array([surprise(b, r, temperature) - surprise(a, r, temperature)
                      for r, (b, a) in enumerate(zip(without, found, strict=True))])
    before = without[0].layout.hypothesis.effects
    effect = any(cls.stage is not Stage.CLOCK for cls, at in found[0].layout.hypothesis.effects
                 if (cls, at) not in before)
    scattered = gains.sum() <= math.sqrt(len(gains)) * float(np.std(gains, ddof=1))
    return bool(scattered and (gains.min() < -REFUTED or effect and gains.sum() < ALONE))
