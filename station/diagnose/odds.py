"""From fits to odds: probabilities over sets of causes that hold when the data are drawn again, and intervals.

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
from scipy.special import stdtrit

from station.diagnose.result import Estimate
from station.diagnose.selection import Selection
from station.diagnose.thresholds import BEYOND, CLOSE, MENTION, OUTSIDE, VARIES
from station.estimation.cause import Causes, Key, constant, constant_path, is_constant
from station.estimation.fitted import Fit
from station.estimation.identifiability import NORMAL, parameter_states
from station.estimation.noise import QUANTISATION
from station.estimation.parameters import Coordinate
from station.estimation.spread import Spread, between_runs, shared
from station.model.effects import effect_class
from station.model.units import UNITS
from station.rig import Rig

RESAMPLES = 400
"""A probability of one half is then known to 0.025."""
SEED = 20240229
MOTOR_GAIN = "motor.gain"
"""What is one with a share of the command by which the motor does more in all runs."""
SEVERAL = 3
"""Runs from which on their scatter widens an interval."""


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
        """Share of the resamples that name a cause of the best set or, beside all the others of it, one more in its
        place, any or one ``among`` some; an effect is the same at whichever of its places."""
        if not self.resampled:
            return 0.0
        ours, rest = ({name for name, _ in keys} for keys in (best, best - {cause}))
        others = None if among is None else {name for name, _ in among}

        def holds(keys: Causes) -> bool:
            names = {name for name, _ in keys}
            new = names - ours if others is None else (names - ours) & others
            return cause[0] in names or rest <= names and bool(new)
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


def may_be_none(found: Fit, key: Key, values: dict[str, Estimate]) -> bool:
    """Whether a cause's own 95 % intervals (``estimates``) hold that it is not there: a constant's the value of the rig
    file, those of all sizes of an effect the neutral one, or one the infinite one (a drag that levels off nowhere).

    Of a size x that is fitted by its logarithm it is the interval of x itself, x (1 +- 1.96 sigma), to first order
    (Wald's test: Trans. Am. Math. Soc. 54, 1943): one of its logarithm never reaches neutral.
    """
    if is_constant(key[0]):
        return values["value"].low <= found.space.rig.stated(constant_path(key[0])) <= values["value"].high

    def holds_none(coordinate: Coordinate) -> bool:
        size = values[coordinate.name]
        if coordinate.log:
            return not size.low > 0.0 or math.log(size.high / size.low) >= 2.0
        return size.low <= coordinate.info.neutral <= size.high

    sizes = [one for one in found.space.coordinates if one.cause == key and one.info.neutral is not None]
    finite = [one for one in sizes if math.isfinite(one.info.neutral)]
    return any(holds_none(one) for one in sizes if one not in finite) or bool(finite) and all(map(holds_none, finite))


def common_gain(found: Fit) -> float:
    """How many times the motor does what a fit's constants say in all runs alike; 1 where that may be chance, or the
    rig file calls its gain exact.

    Of a gain that is wrong in all of a few runs each may be given its own; but what they share is no difference, it is
    the rig's.
    """
    shares = found.own[:, 2]
    exact = float(found.space.rig.log_covariance([MOTOR_GAIN])[0, 0]) == 0.0
    return 1.0 if found.alone or exact or shared(shares) < VARIES else 1.0 + float(np.mean(shares))


def rig_of(found: Fit) -> Rig:
    """The rig that a fit describes, with what the motor does in all runs alike."""
    rig = found.space.rig_at(found.x)
    return rig.with_constants({MOTOR_GAIN: common_gain(found) * rig.motor.gain})


def estimates(found: Fit, rougher: Fit, left_out: Sequence[Fit], *, student: bool = True,
              ) -> tuple[dict[Key, dict[str, Estimate]], dict[str, Estimate]]:
    """Fitted parameters of each cause, and the rig's constants, with 95 % intervals.

    A cause's parameters are known no better than runs agree in them (``spread``), nor than they stay where they are
    when run after run is left out (``left_out``: R fits, one without each): by the jackknife their variance is at least
    (R - 1)/R sum (x_r - mean)^2, whatever the errors are like (Efron and Stein, Ann. Stat. 9, 1981), itself known to
    R - 1 degrees of freedom (Student's t in place of the normal: Tukey, Ann. Math. Stat. 29, 1958, p. 614), unless not
    to be widened by it (``student``).
    A level at which readings stand still is known no better than their one rounding error, uniform over a count.
    ``rougher``: the same set fitted with coarser simulations; how far it lies from ``found`` is what the simulation's
    own steps leave uncertain, and is added to the variance.
    """
    space, covariance, shift = found.space, found.covariance, found.x - rougher.x
    found_states = parameter_states(space, covariance, found.x)
    n = len(space.paths)
    nominal, logs = space.rig.constants(), space.logs(found.x)
    without = np.array([one.x for one in left_out if one.x.size == space.size])

    def jackknife(direction: np.ndarray) -> float:
        values = without @ direction if len(without) >= SEVERAL else np.zeros(1)
        wider = float(stdtrit(max(len(values) - 1, 1), 0.975)) / NORMAL if student else 1.0
        return wider * math.sqrt((len(values) - 1) * float(np.var(values)))
    log_sd = np.sqrt(np.diag(space.root @ covariance[:n, :n] @ space.root.T) + (space.root @ shift[:n]) ** 2)
    constants = {}
    for i, path in enumerate(space.paths):
        value, deviation, between = nominal[path] * math.exp(logs[i]), log_sd[i], None
        value *= common_gain(found) if path == MOTOR_GAIN else 1.0
        if path in space.hypothesis.constants:
            seen = _between(found, space.along_log(path))
            own = space.root[i] @ seen.covariance[:n, :n] @ space.root[i]
            own = max(math.sqrt(own), jackknife(np.append(space.root[i], np.zeros(space.size - n))))
            deviation, between = math.hypot(own, space.root[i] @ shift[:n]), _told(seen, value)
        times = math.exp(NORMAL * deviation)
        least, most = sorted((value / times, value * times))
        constants[path] = Estimate(value=value, low=least, high=most, unit=UNITS[path],
                                   state=found_states[i], spread=between)

    def of_held(path: str) -> Estimate:
        k, direction = space.at_held(path), space.along_log(path)
        one, seen = space.held[k - space.parts["held"].start], _between(found, direction)
        deviation = math.hypot(max(math.sqrt(seen.covariance[k, k]), jackknife(np.eye(space.size)[k])), shift[k])
        value, low, high = (one.value(float(found.x[k] + s * NORMAL * deviation)) for s in (0.0, -1.0, 1.0))
        unit = space.rig.effects[one.effect].parameters()[one.name].unit
        return Estimate(value=value, low=low, high=high, unit=unit, state=found_states[k],
                        spread=_told(seen, 1.0 if one.angle else value))

    causes: dict[Key, dict[str, Estimate]] = {}
    for k, coordinate in enumerate(space.coordinates, space.parts["effects"].start):
        direction = np.eye(space.size)[k]
        seen = _between(found, direction)
        per_step = abs(coordinate.to_value(found.x[k])) if coordinate.log else coordinate.scale
        rounding = math.sqrt(QUANTISATION) / per_step if coordinate.info.rounded else 0.0
        deviation = math.hypot(max(math.sqrt(seen.covariance[k, k]), jackknife(direction)), shift[k], rounding)
        low, high = (float(coordinate.to_value(found.x[k] + s * NORMAL * deviation)) for s in (-1.0, 1.0))
        if coordinate.info.periodic and NORMAL * deviation * coordinate.scale >= math.pi:
            low, high = -math.pi, math.pi
        causes.setdefault(coordinate.cause, {})[coordinate.name] = Estimate(
            value=float(coordinate.to_value(found.x[k])), low=low, high=high, unit=coordinate.info.unit,
            state=found_states[k], spread=None if coordinate.info.periodic else _told(seen, per_step))
    for path in space.hypothesis.constants:
        causes[constant(path)] = {"value": constants[path] if path in constants else of_held(path)}
    return causes, constants


def _between(found: Fit, direction: np.ndarray) -> Spread:
    """How the runs differ along a direction (p) of x; of fewer than three nothing is said."""
    if len(found.squares) < SEVERAL:
        return Spread(0.0, 0.0, found.covariance)
    return between_runs(found, direction)


def _told(seen: Spread, unit: float) -> float | None:
    """The spread in the value's unit, where the runs say that they differ; ``unit``: the value's change per step of x.
    """
    return float(seen.size * unit) if seen.gained > VARIES else None
