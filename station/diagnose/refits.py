"""Fits of sets of causes, taken further: to the end, and with less in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial, reduce
from typing import Any

import numpy as np

from station.diagnose.candidates import candidates
from station.diagnose.equivalences import delays_traded
from station.diagnose.selection import Selection
from station.diagnose.starts import arrived, attempted, has_gap, seeks_zeros
from station.diagnose.thresholds import CLOSE
from station.estimation.cause import Causes, Key, Sizes
from station.estimation.fitted import MOST_GAINED, Fit
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.parameters import Hypothesis, Parameters, parameters
from station.estimation.prediction import Predictor
from station.model.effects import effect_class

THOROUGH: dict[str, Any] = {"iterations": 25, "renewals": 4, "tolerance": 0.2}


def centred(predictor: Predictor, found: Fit, complete: bool) -> tuple[Parameters, np.ndarray]:
    """A hypothesis whose effects' priors stand at the usual sizes nearest to those found, and the fit's point in it.

    Sizes are as likely about any of an effect's usual ones; where a fit happened to begin must not count.  Usual are
    those that show on rigs of which no model is quite right.  Where nothing but noise is left (``complete``) smaller
    ones show, too, and of these only the order of magnitude is unknown, as it is of what runs differ by.
    """
    space, values = found.space, found.space.values(found.x)

    def strain(cause: Key, guess: dict[str, float]) -> float:
        return sum(space.precision[i] * (coordinate.to_x(guess[coordinate.name]) - found.x[i]) ** 2
                   for i, coordinate in enumerate(space.coordinates, space.parts["effects"].start)
                   if coordinate.cause == cause)

    rig, centres = predictor.data.rig, {}
    for cls, at in space.hypothesis.effects:
        usual = cls.guesses_at(rig, at, predictor.data.speed)
        smaller = cls.smaller(usual, values[cls.name, at]) if complete else []
        centres[cls.name, at] = min([*usual, *smaller], key=partial(strain, (cls.name, at)))
    moved = parameters(predictor.data, space.hypothesis, centres)
    return moved, moved.carried(space, found.x)


def refit(search: Selection, fits: Iterable[Fit], to_the_end: bool,
           told: Callable[[float, str], None] = lambda share, label: None, anew: bool = False) -> None:
    """Fit sets to the end, each with what runs differ by by itself, side by side; ``anew``: from nominal constants,
    too, for the rig alone bends them farthest.

    Where a set may do without (``Selection.evidence``) it is fitted so, too: what runs differ by stood in for its
    causes, and about that fit the runs do differ.  Not where it is expected to be no rival of itself then.
    """
    predictor, weighing, complete = search.predictor, search.weighing, search.complete

    def again(job: tuple[Fit, tuple[float, float]]) -> Fit | None:
        found, differ = job
        space, x = centred(predictor, found, complete)
        way = arrived if found.key in sought else attempted
        return way(predictor, space, replace(weighing, differ=differ), x, found.own, **THOROUGH,
                   to_the_end=to_the_end)

    fits, jobs = list(fits), []
    sought = {found.key for found in fits
              if anew or seeks_zeros(found.space) or not complete and has_gap(found.space)}
    sought -= search.arrived
    search.arrived |= sought
    for found in fits:
        own = search.own_weighing(found).differ
        alike = found.most_likely_differ(replace(weighing, may=(False, False)))
        jobs.append((found, own))
        if complete and alike != own:
            without = found.log_expected(replace(search.compared, differ=alike))
            if search.evidence(found) - without < CLOSE + 0.5 * MOST_GAINED:
                jobs.append((found, alike))
    for k, ((old, _), found) in enumerate(zip(jobs, predictor.pool.map(again, jobs), strict=True)):
        if found is not None:
            search.keep(found, old)
            told((k + 1) / len(jobs), found.space.hypothesis.label)


def look_back(search: Selection, found: Fit) -> None:
    """Fit every set with one cause less, with a simpler law in the place of one that holds it, with a law at another of
    its places, or with other delays of the same sums, from where the whole set ended: each cause must hold against its
    absence, each law against those that are special cases of it and against itself elsewhere, and delays against those
    that show alike."""
    search.looked_back = found.light
    hypothesis, sizes = found.space.hypothesis, found.space.values(found.x)
    less: list[tuple[Hypothesis, Sizes]] = [(hypothesis.without(cause), {}) for cause in hypothesis.causes]
    allowed = {candidate.key for candidate in candidates(search.predictor.data.rig)}
    for cls, at in hypothesis.effects:
        own = sizes[cls.name, at]
        elsewhere = {(cls.name, place): own for place in cls.sites}
        for (name, place), size in (elsewhere | cls.cases(found.space.rig, at, own)).items():
            if (name, place) in allowed - found.key:
                instead = hypothesis.without((cls.name, at)) + Hypothesis(((effect_class(name), place),))
                less.append((instead, {(name, place): size}))
    for causes, delays in delays_traded(found.key, found.space.rig_at(found.x), allowed):
        if len(causes) <= len(found.key):
            kept = reduce(Hypothesis.without, sorted(found.key - causes), hypothesis)
            traded = kept + Hypothesis(tuple((effect_class(name), place) for name, place in sorted(causes - found.key)))
            less.append((traded, delays))
            if len(delays) > 1:     # one that is nearly none
                less.append((traded.without(min(sorted(delays), key=lambda key: delays[key]["time"])), delays))
    _keep_reduced(search, found, less)


def _keep_reduced(search: Selection, found: Fit, less: Sequence[tuple[Hypothesis, Sizes]]) -> None:
    """Sets that hold less than another, or a law elsewhere, with sizes of what that one does not hold, fitted from
    where it ended; none that does not simulate."""
    predictor, found = search.predictor, found.light
    # What explains less may need runs to differ by as much as the rig alone does.
    share, constant = np.maximum(search.own_weighing(found).differ,
                                 search.own_weighing(search.fits[frozenset()]).differ).tolist()
    weighing = replace(search.weighing, differ=(share, constant))

    def reduced(one: tuple[Hypothesis, Sizes]) -> Fit | None:
        hypothesis, sizes = one
        space = parameters(predictor.data, hypothesis, {**found.space.values(found.space.mean), **sizes})
        return attempted(predictor, space, weighing, space.carried(found.space, found.x, sizes), found.own, **THOROUGH)

    for one in predictor.pool.map(reduced, less):
        if one is not None:
            search.keep(one)


def fitted(search: Selection, causes: Causes, whole: Causes) -> Fit:
    """The fit of some causes of a set, made where the search has not; of nothing where they do not simulate."""
    if causes not in search.fits:
        hypothesis = search.fits[whole].space.hypothesis
        for cause in whole - causes:
            hypothesis = hypothesis.without(cause)
        _keep_reduced(search, search.fits[whole], [(hypothesis, {})])
    return search.fits.get(causes, search.fits[frozenset()])


def free(search: Selection) -> None:
    """Let runs differ where they were held alike while causes were sought: each set tells anew by how much."""
    def freed(weighing: Weighing) -> Weighing:
        return replace(weighing, may=(True, True))

    search.weighing = freed(search.weighing)
    search.fits = {key: replace(one, weighing=freed(one.weighing)) for key, one in search.fits.items()}
    search._weighed.clear()
    best = search.best()
    search.keep(fit(search.predictor, best.space, search.own_weighing(best), best.x, best.own).light, best)
    search.weigh(search.best())


def finish(search: Selection) -> None:
    """Fit the likeliest sets to the end under a weighing that the best of them gives.

    It ends where the best is best by its own weighing, or where one comes back by whose weighing another was: that
    would never end.
    """
    _to_the_end(search)
    read = [search.reading]
    while search.wanted not in read:
        search.weigh(search.best())
        read.append(search.reading)
        _to_the_end(search)


def _to_the_end(search: Selection) -> None:
    """Fit the best set, its close rivals and its subsets to the end: none loses by where it ended.

    A best that ended in another valley is looked back upon once more: no set with less was begun there.
    """
    best = search.best()
    close = search.close(2 * search.effort.finished)
    subsets = [f for f in search.fits.values() if f.key < best.key and f not in close]
    refit(search, [*close, *subsets], True)
    best = search.best()
    if search.looked_back is None or search.is_news(best, search.looked_back):
        look_back(search, best)
