"""Searching causes: the rig alone is fitted, then one cause more at a time; every set is judged by one score.

Each rung screens all causes on top of the best set so far (``screening``), fits those expected to gain most, and looks
back: a set must hold against every set with one cause less.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from operator import methodcaller

import numpy as np

from station.diagnose.candidates import Candidate, candidates
from station.diagnose.effort import Effort
from station.diagnose.refits import centred, finish, free, look_back, refit
from station.diagnose.rung import RUNGS, proposed
from station.diagnose.selection import Selection
from station.diagnose.starts import Start, far_starts
from station.diagnose.thresholds import WORTH_A_FIT
from station.estimation.cause import Causes
from station.estimation.constants import base_fit, in_step, settled
from station.estimation.fitted import Fit
from station.estimation.least_squares import fit, point
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.prediction import FINE, Predictor
from station.model.effects import Stage


def select(predictor: Predictor, effort: Effort, progress: Callable[[str, float], None]) -> Selection:
    """The whole search."""
    progress("fitting the nominal rig's constants", 0.05)
    alone = parameters(predictor.data, Hypothesis(), {})
    beginnings = in_step(predictor, alone, alone.mean)
    parent = base_fit(predictor, beginnings)
    search = Selection(predictor, effort, parent.weighing)
    search.keep(search.weigh(parent))
    parent = _with_derivatives(search, search.fits[parent.key])
    pool = candidates(predictor.data.rig, predictor.data.speed)
    far = far_starts(predictor, pool, effort.finished, beginnings)
    climbed: set[Causes] = set()
    while parent.key not in climbed:
        climbed.add(parent.key)
        rung = len(parent.key)
        if rung > 0 and predictor.data.clock is None:
            # Beside another cause a clock is but one more way to move the constants, which no data tell from theirs.
            pool = [c for c in pool if c.effect is None or c.effect.stage is not Stage.CLOCK]
        further = [c for c in pool if c.key not in parent.key and not parent.space.hypothesis.holds(c.key)]
        _climb(search, parent, further, [] if rung else far, progress)
        best = search.best()
        if not search.is_news(best, search.fits[parent.key]):
            break
        look_back(search, _settle(search, best))
        if search.wanted != search.reading:
            _settle(search, search.best())
        parent = _with_derivatives(search, search.best())
    progress("fitting rivals as far as the best", 0.82)
    if not all(search.weighing.may):
        free(search)
    finish(search)
    _compare_exactly(search)
    search.judge()
    return search


def _compare_exactly(search: Selection) -> None:
    """Bring the likeliest sets to their end by finer simulations where only noise is left and what the search's own err
    by could decide between them: of a fine encoder that is more than what some laws change."""
    quick, finer = search.all_horizons, replace(search.predictor, accuracy=FINE)
    if search.complete and quick.accuracy != FINE:
        moved = [point(finer, one.space, one.weighing, one.x, one.own).objective - one.objective
                 for one in search.close(2 * search.effort.finished)]
        if not np.ptp(moved) < WORTH_A_FIT:     # nor where one is lost
            search.all_horizons = replace(quick, accuracy=FINE)
            finish(search)
            search.all_horizons = quick


def _settle(search: Selection, best: Fit) -> Fit:
    """The best set, settled under the weighing that it gives, and its rivals fitted again: where the weighing changed
    theirs are not comparable."""
    rivals = search.close(1 + search.effort.finished)[1:]
    best = search.weigh(settled(search.predictor, best))
    search.keep(best)
    refit(search, [search.fits[rival.key] for rival in rivals], False)
    return best


def _with_derivatives(search: Selection, found: Fit) -> Fit:
    """The same set, fitted to the end under the weighing in force, with derivatives to hand on.

    They are worked out where it ended: of what screening takes out by them little is left, and that must be right.
    """
    space, x = centred(search.predictor, found, search.complete)
    again = fit(search.predictor, space, search.own_weighing(found), x, found.own, to_the_end=True)
    search.keep(again, found)
    return again


def _climb(search: Selection, parent: Fit, pool: list[Candidate], far: list[Start],
           progress: Callable[[str, float], None]) -> None:
    """Fit what ``rung`` proposes on top of a parent, then the most promising of it to the end."""
    predictor, rung = search.predictor, len(parent.key)
    begin, end = (min(0.1 + 0.7 * done / (RUNGS + 1), 0.8) for done in (rung, rung + 1))

    def told(text: str, share: float) -> None:
        progress(text, begin + (end - begin) * share)

    jobs = proposed(search, parent, pool, far)
    found: dict[Causes, Fit] = {}
    expected: dict[Causes, float] = {}
    ends = predictor.pool.map(methodcaller("fitted", predictor, search.weighing, parent), jobs)
    for k, (job, one) in enumerate(zip(jobs, ends, strict=True)):
        told(f"tried {job.label}", 0.6 * (k + 1) / len(jobs))
        if one is not None:
            search.keep(one)
            expected[one.key] = min(expected.get(one.key, np.inf), parent.objective - job.gain)
            if one.key not in found or one.objective < found[one.key].objective:
                found[one.key] = one
    ranked = leading(search, found, expected)[: search.effort.finished]
    refit(search, [search.fits[f.key] for f in ranked], False,
          lambda share, label: told(f"fitted {label}", 0.6 + 0.4 * share), anew=not parent.key)


def leading(search: Selection, found: dict[Causes, Fit], expected: dict[Causes, float]) -> list[Fit]:
    """Fits of a few steps in the order in which they are taken further: the best one, then by what they may reach.

    A fit that stopped above the objective that screening expects of its causes (``expected``) has not arrived, and may
    reach that: screening expects no more than the likelihood gives, as far as predictions are linear.
    """
    def may_reach(one: Fit) -> float:
        return search.score(one) + 0.5 * max(one.objective - expected.get(one.key, np.inf), 0.0)

    best = max(found.values(), key=search.score, default=None)
    return sorted(found.values(), key=lambda one: (one is not best, -may_reach(one)))
