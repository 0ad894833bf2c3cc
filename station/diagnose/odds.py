"""From fits to odds: probabilities over sets of causes that hold when the data are drawn again.

The posterior over sets is averaged over resamples of the runs' stretches (bagged posterior: Huggins and Miller,
Bayesian Analysis 18, 2023), each stretch weighing as much as a draw of the Bayesian bootstrap says (Rubin, Ann. Stat.
9, 1981).  Where no model is quite right a posterior of all data is sure of whichever wins by a little; the average is
as sure as the data would be if they came again.  The share of resamples in which a cause is in the best set is its
stability; it counts the resamples and the runs left out one by one alike.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import isotonic_regression

from station.diagnose.selection import Selection
from station.diagnose.thresholds import BEYOND, CLOSE, MENTION, OUTSIDE
from station.estimation.cause import Causes, Key, constant_path, is_constant
from station.estimation.fitted import Fit
from station.estimation.identifiability import NORMAL
from station.model.effects import effect_class

RESAMPLES = 400
"""A probability of one half is then known to 0.025."""
SEED = 20240229


@dataclass(frozen=True, eq=False)
class Draws:
    """What the data say where they are drawn again; k draws, s stretches, m sets."""

    counts: np.ndarray
    """(k, s) how often each stretch counts."""
    sets: list[Causes]
    posterior: np.ndarray
    """(k, m) probability of every set."""

    def error(self, one: Key, other: Key) -> float:
        """Standard error of what one law is more probable by than another, as the data that are there are a sample.

        By the infinitesimal jackknife: the mean of the draws changes with the count of stretch s by the covariance of
        the two over the draws, whose squares add up (Efron, J. Am. Stat. Assoc. 109, 2014), less what so many draws
        make of nothing, s/k of their variance (Wager, Hastie and Efron, J. Mach. Learn. Res. 15, 2014); and a k-th of
        that, for the mean is of so many.
        """
        mine, its = (np.array([any(name == key[0] for name, _ in keys) for keys in self.sets], dtype=float)
                     for key in (one, other))
        more = self.posterior @ (mine - its)
        k, s, more = len(self.counts), np.count_nonzero(self.counts.any(axis=0)), more - more.mean()
        slopes = (self.counts - self.counts.mean(axis=0)).T @ more / k
        variance = float(more @ more) / k
        return math.sqrt(max(float(slopes @ slopes) - s * variance / k, 0.0) + variance / k)


@dataclass(frozen=True)
class Odds:
    """Probabilities of the fitted sets and of every cause."""

    sets: list[tuple[Causes, float]]
    """Best first."""
    causes: dict[Key, float]
    nothing: float
    stability: dict[Key, float]
    """Share of resamples in which the cause is in the best set."""
    laws: dict[str, float] = field(default_factory=dict)
    """The same of an effect, at whichever of its places."""
    resampled: tuple[Causes, ...] = ()
    """The best set of every resample."""
    draws: Draws | None = None
    """What they are read off; None where they are not of draws."""

    def in_its_place(self, best: Causes, cause: Key, among: Causes | None = None) -> float:
        """Share of the resamples that name a cause of the best set or one more in its place: any beside all the others
        of it, or one ``among`` some, that do the same; an effect is the same at whichever of its places."""
        if not self.resampled:
            return 0.0
        ours, rest = ({name for name, _ in keys} for keys in (best, best - {cause}))
        others = None if among is None else {name for name, _ in among}

        def holds(keys: Causes) -> bool:
            names = {name for name, _ in keys}
            new = names - ours
            return cause[0] in names or (rest <= names and bool(new) if others is None else bool(new & others))
        return sum(map(holds, self.resampled)) / len(self.resampled)

    def replacements(self, best: Causes, cause: Key) -> dict[Key, float]:
        """For each cause outside the best set: the probability of sets that hold it instead of ``cause``.

        In a set that holds the same law at another place that place is what stands instead, and nothing beside it.
        """
        found: dict[Key, float] = {}
        for keys, probability in self.sets:
            if cause in keys:
                continue
            new = keys - best
            for key in sorted({key for key in new if key[0] == cause[0]} or new):
                found[key] = found.get(key, 0.0) + probability
        return found


def resamples(search: Selection) -> np.ndarray:
    """(k, stretches): how often each stretch counts; leaving out each run once, where there are several, then draws.

    Stretches in which no row counts (of a run that is alone those of its other half) are not drawn: the data that there
    are count as much in every draw.
    """
    data = search.predictor.data
    owner = data.segment_run
    draws = np.random.default_rng(SEED).exponential(size=(RESAMPLES, len(owner))) * data.segment_counts
    draws *= data.segment_counts.sum() / draws.sum(axis=1, keepdims=True)
    runs = np.unique(owner)
    left_out = np.array([(owner != r).astype(float) for r in runs]) if len(runs) > 2 else np.zeros((0, len(owner)))
    return np.concatenate([left_out, draws])


def odds(search: Selection) -> Odds:
    """Bagged odds of all fitted sets whose causes may be accused."""
    allowed = [(keys, found) for keys, found in search.fits.items()
               if all(may_be_accused(found, key) for key in keys)]
    whole = np.array([search.score(found) for _, found in allowed])
    near = [k for k in range(len(allowed)) if whole[k] > whole.max() - 2.0 * CLOSE]
    drawn = resamples(search)
    scores = np.stack([search.scores(allowed[k][1], drawn) for k in near], axis=1)
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    posterior = (weights / weights.sum(axis=1, keepdims=True))[-RESAMPLES:]
    chosen = [allowed[near[k]][0] for k in scores.argmax(axis=1)]
    named = Counter(key for keys in chosen for key in keys)
    of_law = Counter(name for keys in chosen for name in {name for name, _ in keys})
    stability = {key: count / len(chosen) for key, count in named.items()}
    laws = {name: count / len(chosen) for name, count in of_law.items()}
    sets = [allowed[k][0] for k in near]
    found = _odds(list(zip(sets, posterior.mean(axis=0).tolist(), strict=True)), stability)
    return replace(found, laws=laws, resampled=tuple(chosen), draws=Draws(drawn[-RESAMPLES:], sets, posterior))


def by_law(found: Odds) -> Odds:
    """The odds by which causes are stated: of an effect at one of several places the law's own, whichever its place.

    Where parts hardly move against each other, friction at one of them is friction at the other, and the runs say
    less of the place than of the law.  It stands at the first of its places, in the order of its class, whose odds
    against the likeliest are MENTION at least; the others are rivals.
    """
    for name, at in sorted(found.sets[0][0]):
        best, sets = found.sets[0][0], dict(found.sets)
        places = {key: p for key, p in found.causes.items() if key[0] == name}
        if len(places) < 2 or sum(other == name for other, _ in best) > 1:
            continue
        first = next(key for site in effect_class(name).sites
                     if places.get(key := (name, site), 0.0) >= MENTION * max(places.values()))
        moved = best - {(name, at)} | {first}
        if moved not in sets:
            first, moved = (name, at), best
        whole = sum(p for keys, p in found.sets if any(other == name for other, _ in keys))
        found = replace(found, causes={**found.causes, first: whole},
                        stability={**found.stability, first: found.laws.get(name, 0.0)},
                        sets=[(moved, sets[moved]), *(row for row in found.sets if row[0] != moved)])
    return found


def in_order(found: Odds, causes: Causes, bought: Callable[[Key], float], error: Callable[[Key, Key], float],
             ) -> tuple[list[Key], Odds]:
    """Causes by probability, those of which the runs cannot say which is more probable (``error`` of the difference) by
    what all data buy with each (``bought``, ln), and odds in which what stands in such an order has one probability.

    Two are told apart at 95 %.  Probabilities that contradict an order have their common mean in its place (isotonic
    regression: Barlow, Bartholomew, Bremner and Brunk, Statistical Inference under Order Restrictions, 1972).
    """
    def surer(one: Key, other: Key) -> bool:
        return found.causes[one] - found.causes[other] > NORMAL * error(one, other)

    order: list[Key] = []
    for key in sorted(sorted(causes), key=bought, reverse=True):
        place = len(order)
        while place and surer(key, order[place - 1]):
            place -= 1
        order.insert(place, key)
    if not order:
        return order, found
    pooled = isotonic_regression([found.causes[key] for key in order], increasing=False).x
    return order, replace(found, causes={**found.causes, **dict(zip(order, pooled.tolist(), strict=True))})


def with_outside(found: Odds) -> Odds:
    """The odds where more than noise is left, and what acts may be none of the catalogue's causes (an M-open view:
    Bernardo and Smith, Bayesian Theory, 1994, section 6.1.2).

    Something outside it that does what a set of causes does would be met by that set as well, and leave as much.  So
    the data say nothing between the two, and what was believed of it beforehand (OUTSIDE) stays.  Where only noise is
    left nothing outside is needed.
    """
    inside = 1.0 - OUTSIDE
    return replace(found, sets=[(keys, inside * p) for keys, p in found.sets], nothing=inside * found.nothing,
                   causes={key: inside * p for key, p in found.causes.items()})


def normalised(scores: dict[Causes, float], stability: dict[Key, float]) -> Odds:
    """Odds from the log weight of every set."""
    top = max(scores.values())
    weights = [(keys, math.exp(max(score - top, -700.0))) for keys, score in scores.items()]
    total = sum(w for _, w in weights)
    return _odds([(keys, w / total) for keys, w in weights], stability)


def _odds(found: Sequence[tuple[Causes, float]], stability: dict[Key, float]) -> Odds:
    sets = sorted(found, key=lambda row: (-row[1], sorted(row[0])))
    causes: dict[Key, float] = {}
    for keys, probability in sets:
        for key in sorted(keys):
            causes[key] = causes.get(key, 0.0) + probability
    return Odds(sets, causes, sum(p for keys, p in sets if not keys), stability)


def may_be_accused(found: Fit, key: Key) -> bool:
    """Whether a cause may be accused: a constant beyond BEYOND of its own sigma, and an effect of which the runs say
    that its sizes are such as it may have; at the largest they ask for another thing."""
    if not is_constant(key[0]):
        return possible(found, key)
    return found.space.deviation(found.x, constant_path(key[0])) > BEYOND


def possible(found: Fit, key: Key) -> bool:
    """Whether the 95 % intervals of an effect's sizes end below the largest that it may have (``Effect.largest``)."""
    space, largest = found.space, effect_class(key[0]).largest(found.space.rig, key[1])
    return all(coordinate.to_value(found.x[k] + NORMAL * math.sqrt(found.covariance[k, k])) < largest[coordinate.name]
               for k, coordinate in enumerate(space.coordinates, space.parts["effects"].start)
               if coordinate.cause == key and coordinate.name in largest)
