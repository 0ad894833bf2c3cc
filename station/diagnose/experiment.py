"""The next experiment: of the tests that the station can run, the one that is worth most, and what it should show.

Where causes are rivals, that is the test which tells them apart (``separating``); where nothing points anywhere yet,
the one that makes the catalogue visible (``showing``).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from station.diagnose.candidates import candidates
from station.diagnose.forecasts import Belief
from station.diagnose.odds import Odds
from station.diagnose.planner import Planner, Worth
from station.diagnose.result import Choice, NextExperiment, Verdict
from station.diagnose.selection import Selection
from station.diagnose.separating import between
from station.diagnose.showing import showing
from station.diagnose.thresholds import SETTLED, UNLIKELY
from station.diagnose.trials import trials
from station.estimation.cause import Key, in_words
from station.estimation.dataset import tests_of
from station.estimation.fitted import Fit
from station.estimation.loaded import PREPARE
from station.estimation.noise import ACCEL_DEFAULT, QUANTISATION
from station.estimation.parameters import prior_covariance
from station.estimation.pool import SIZE, Pool
from station.estimation.prediction import built
from station.model.effects import Effect, Stage, catalogue
from station.model.simulate import Model
from station.rig import Rig

LEADING = 4
"""Sets of causes that are weighed."""
AXES = 10
"""Directions of the posterior, widest first, whose predictions are worked out."""
PRIOR_REACH = 2.0
"""Times the reach that a test may take where the stated uncertainty may put the rig."""
PRIOR_DRAWS = 6
"""Draws from the rig's stated uncertainty on which the first test must behave."""


def choose(search: Selection, odds: Odds, verdict: Verdict) -> Choice:
    """What to do next, by the odds of the sets of causes that were fitted."""
    data = search.predictor.data
    planner = Planner(data.rig, _sigma(search), search.predictor.pool, tests_of(data.runs))
    best, top = odds.sets[0]
    rivals = [(keys, p) for keys, p in odds.sets[:LEADING] if p >= UNLIKELY * top]
    undecidable = None
    if top < SETTLED and len(rivals) > 1 and verdict not in ("not_enough_data", "unexplained"):
        causes = sorted({key for keys, _ in rivals for key in keys})
        beliefs = [belief(search, search.fits[keys]) for keys, _ in rivals]
        found = planner.best(between(planner, beliefs, [p for _, p in rivals]), trials(data.rig, causes))
        if found is not None and found.decides:
            return _choice(replace(found, why=found.why + _telling(best)), planner)
        if verdict == "ambiguous":
            undecidable = (f"{beliefs[0].words} and {beliefs[1].words} predict the same in every test that "
                           "this station can run, within what refitted constants absorb"
                           + (f" (chi^2 = {found.distance:.1f} at most)" if found is not None else ""))
    # The rig as fitted without its effects, which cost time, and as uncertain as before any run.
    fit, space = search.fits[best], search.fits[frozenset()].space
    plain = Belief("the rig as fitted", space.carried(fit.space, fit.x), np.eye(space.size),
                   partial(search.predictor.model, space))
    judge = showing(planner, plain, _addable(data.rig, best), [belief(search, fit)])
    plan = _choice(planner.best(judge, trials(data.rig)), planner)
    if undecidable is not None:
        return replace(plan, next=NextExperiment(test=None, why=undecidable), prediction=None)
    return plan


def first_test(rig: Rig) -> Choice:
    """The first test of a rig that nothing is known of but its file: the one that makes most of the catalogue visible
    and behaves wherever the stated uncertainty may put the rig."""
    with threadpool_limits(1):
        return _first_test(rig.meshed())


def _first_test(rig: Rig) -> Choice:
    paths, nominal = list(rig.constants()), np.array(list(rig.constants().values()))
    root = np.linalg.cholesky(prior_covariance(rig, paths))

    def model(x: np.ndarray) -> Model:
        return built(rig.with_constants(dict(zip(paths, nominal * np.exp(root @ x), strict=True))))

    accel = [np.hypot(ACCEL_DEFAULT, np.sqrt(QUANTISATION))] if rig.accelerometer is not None else []
    base = Belief("the rig as its file says", np.zeros(len(paths)), np.eye(len(paths)), model)
    drawn = [replace(base, x=x) for x in np.random.default_rng(0).normal(size=(PRIOR_DRAWS, len(paths)))]
    planner = Planner(rig, np.array([np.sqrt(QUANTISATION), *accel]), Pool(SIZE, PREPARE))
    found = (planner.best(showing(planner, base, _addable(rig), drawn, PRIOR_REACH), trials(rig))
             or planner.best(showing(planner, base, _addable(rig)), trials(rig)))
    return _choice(found, planner)


def belief(search: Selection, found: Fit) -> Belief:
    """A fitted hypothesis as its data leave it."""
    values, vectors = np.linalg.eigh(found.covariance)
    widest = np.argsort(-values)[:AXES]
    axes = vectors[:, widest] * np.sqrt(np.maximum(values[widest], 0.0))
    return Belief(_words(found.key), found.x, axes, partial(search.predictor.model, found.space))


def _addable(rig: Rig, held: frozenset[Key] = frozenset()) -> list[tuple[str, Effect]]:
    """Every effect that could join a rig, at the middle of its usual sizes."""
    return [(_words([c.key]), c.effect.model_construct(None, at=c.at, **c.guesses[(len(c.guesses) - 1) // 2]))
            for c in candidates(rig)
            if c.effect is not None and c.key not in held and c.effect.stage is not Stage.CLOCK]


def _sigma(search: Selection) -> np.ndarray:
    """Noise of a planned run; where a model misses something, the size of that, spread over its samples."""
    data, best = search.predictor.data, search.best()
    left = np.mean(np.maximum(best.squares / np.maximum(search.weighing.independent, 1.0), 1.0), axis=0)
    return data.sigma * np.sqrt(left[search.predictor.longest])


def _choice(found: Worth | None, planner: Planner) -> Choice:
    if found is None:
        none = NextExperiment(test=None, why="no test of this station keeps this rig within "
                                             f"{planner.reach:.0f} counts of where it begins, no faster than it may go")
        return Choice(none, plan=none)
    asked = NextExperiment(test=found.trial.complete(), why=found.why)
    return Choice(asked, found.prediction, asked, found.shown)


def _telling(keys: frozenset[Key]) -> str:
    """What to look for in a test that tells effects from their rivals, in the effects' own words."""
    known = catalogue()
    words = [f"{known[name].title}: {known[name].telling}" for name, _ in sorted(keys)
             if name in known and known[name].telling]
    return f" ({'. '.join(words)})" if words else ""


def _words(keys: Iterable[Key]) -> str:
    return " + ".join(sorted(map(in_words, keys))) or "no cause"
