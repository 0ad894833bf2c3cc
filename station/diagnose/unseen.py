"""What a fitted set of causes says of runs left out.

Causes are held against their absence by fits that leave run after run out: by the density of that run, its uncertain
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


def unseen_gain(without: Sequence[Fit], found: Sequence[Fit]) -> float:
    """By how much causes lower the error of unseen runs; a share of the error without them.

    Of fits that leave run after run out, the root of chi^2 of the runs left out, their own nuisances fitted.
    """
    before, after = (math.sqrt(sum(float(left.costs[r].sum() + left.penalty[r]) for r, left in enumerate(fits)))
                     for fits in (without, found))
    return 1.0 - after / before if before > 0.0 else 0.0


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
