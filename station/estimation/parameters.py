"""Hypotheses, and the parameters that each one lets a fit move.

A rig's constants enter as w with log(c/c_nominal) = L w, L L' their prior covariance, so that their prior is |w|^2.
Positive sizes of effects enter by their logarithm, others in units of a usual size; each has a Gaussian prior.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from scipy.special import ndtr

from station.estimation.cause import Causes, Key, Sizes, constant
from station.estimation.dataset import Dataset
from station.model.effects import Effect, ParameterInfo, Stage
from station.rig import Rig

FARTHEST = 8.0
"""Largest logarithm of a constant over its nominal value that is ever simulated."""
WIDE = 1.5
"""Prior sigma of the logarithm of a constant that a hypothesis sets free, and of an effect's size."""
PLACE, PHASE = 2.0, 3.2
"""Prior sigmas of signed sizes, in units of a usual one, and of phases, rad (wider than a turn: none is preferred)."""
CLOCK_SIGMA = 0.04
"""Prior sigma of the logarithm of a clock's ratio where no second clock watched it: what an oscillator without a quartz
is made to (the PSoC 5LP's, 24 MHz: 4 %, CY8C58LP's data sheet); a quartz is far better."""

EXACT = 1e-6
"""Sigma of the logarithm of a constant that a rig file calls exact."""


@dataclass(frozen=True)
class Coordinate:
    """One parameter of an effect as a fit moves it: value = exp(x), or origin + scale x."""

    cause: Key
    name: str
    info: ParameterInfo
    log: bool
    scale: float
    high: float
    """Largest value that is physical on this rig."""
    origin: float

    def to_value(self, x: float) -> float:
        """The parameter's value, kept within its bounds."""
        value = math.exp(min(max(x, -80.0), 80.0)) if self.log else self.origin + self.scale * x
        if self.info.periodic:
            return (value + math.pi) % (2.0 * math.pi) - math.pi
        return min(max(value, self.info.low), self.high)

    def to_x(self, value: float) -> float:
        """Inverse of ``to_value``."""
        return math.log(max(value, 1e-300)) if self.log else (value - self.origin) / self.scale


@dataclass(frozen=True)
class Hypothesis:
    """A set of causes: effects (class, place) on top of the rig's own, and constants set free."""

    effects: tuple[tuple[type[Effect], str], ...] = ()
    constants: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """For tables and progress."""
        return " + ".join(f"{name}@{at}" if at else name for name, at in self.causes) or "nothing"

    @property
    def causes(self) -> list[Key]:
        """(effect, at) of every cause, as the diagnosis file names them."""
        return [(cls.name, at) for cls, at in self.effects] + [constant(c) for c in self.constants]

    @property
    def key(self) -> Causes:
        """The causes as a set."""
        return frozenset(self.causes)

    def holds(self, cause: Key) -> bool:
        """Whether a law at the same place has this one as a special case: beside it, it adds nothing."""
        return any(cause[0] in cls.simpler and cause[1] == at for cls, at in self.effects)

    def __add__(self, other: Hypothesis) -> Hypothesis:
        return Hypothesis(self.effects + other.effects, self.constants + other.constants)

    def without(self, cause: Key) -> Hypothesis:
        """The same with one cause less."""
        return Hypothesis(tuple((cls, at) for cls, at in self.effects if (cls.name, at) != cause),
                          tuple(c for c in self.constants if constant(c) != cause))


@dataclass(frozen=True)
class Held:
    """A parameter of an effect that the rig file holds, with the uncertainty stated there."""

    effect: int
    name: str
    path: str
    """As the rig file's uncertainty names it: ``gravity_tilt.torque``."""
    nominal: float
    sigma: float
    """Of its logarithm, of an angle itself, rad."""
    angle: bool

    @property
    def free(self) -> Held:
        """The same where a hypothesis sets it free."""
        return replace(self, sigma=math.hypot(self.sigma, PHASE if self.angle else WIDE))

    def value(self, away: float) -> float:
        """So many sigmas from nominal."""
        moved = self.sigma * away
        return self.nominal + moved if self.angle else self.nominal * math.exp(moved)


@dataclass(frozen=True, eq=False)
class Parameters:
    """Where the parameters of one hypothesis stand in a vector x, and their prior.

    x = [constants | effects' parameters | encoder zeros | parameters of effects held | share of back-EMF | places in a
    gap].
    """

    rig: Rig
    hypothesis: Hypothesis
    paths: tuple[str, ...]
    root: np.ndarray
    """(n, k) L, the logarithms of the constants over nominal per unit of x; k < n ``along`` some directions alone."""
    coordinates: tuple[Coordinate, ...]
    known_zeros: int
    """1 where absolute angles are counted from the zero of the first group of runs, 0 where the rig's own effects say
    where they are."""
    zeros: int
    """Encoder zeros whose absolute angle is unknown: of the groups of runs after the known one, or of none."""
    held: tuple[Held, ...]
    back_emf: int
    """1 where it matters how much of the motor's damping is back-EMF, and the rig file does not say, else 0."""
    gap_places: int
    mean: np.ndarray
    """(p) of the prior."""
    precision: np.ndarray
    """(p) of the prior."""

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return self.mean.size

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Where each kind of parameter stands in x."""
        counts = {"constants": self.root.shape[1], "effects": len(self.coordinates), "zeros": self.zeros,
                  "held": len(self.held), "back_emf": self.back_emf, "places": self.gap_places}
        ends = accumulate(counts.values())
        return {name: slice(end - counts[name], end) for name, end in zip(counts, ends, strict=True)}

    def logs(self, x: np.ndarray) -> np.ndarray:
        """Logarithms of the constants over nominal."""
        return self.root @ x[self.parts["constants"]]

    def at_held(self, path: str) -> int:
        """Where in x a parameter stands of an effect that the rig file holds."""
        return self.parts["held"].start + [one.path for one in self.held].index(path)

    def deviation(self, x: np.ndarray, path: str) -> float:
        """How far a constant is from nominal, in its own sigma, given what the others say of a common factor."""
        if path not in self.paths:
            k = self.at_held(path)
            return abs(float(x[k])) * self.held[k - self.parts["held"].start].sigma / self.rig.uncertainty[path]
        logs, i, covariance = self.logs(x), self.paths.index(path), self.rig.log_covariance(list(self.paths))
        shared = np.flatnonzero((covariance[i] != 0.0) & (np.arange(len(logs)) != i))
        gain = np.linalg.solve(covariance[np.ix_(shared, shared)], covariance[shared, i])
        variance = covariance[i, i] - float(gain @ covariance[shared, i])
        return abs(float(logs[i]) - float(gain @ logs[shared])) / math.sqrt(max(variance, self.rig.sigma(path) ** 2))

    def placed(self, x: np.ndarray, logs: np.ndarray) -> np.ndarray:
        """``x`` (p) with the constants where their logarithms over nominal are ``logs`` (n)."""
        x = x.copy()
        x[self.parts["constants"]] = np.linalg.solve(self.root, logs)
        return x

    def along_log(self, path: str) -> np.ndarray:
        """(p) the direction of x along which the logarithm of one constant, or an angle, moves and the others' do not.
        """
        if path not in self.paths:
            k = self.at_held(path)
            return (np.arange(self.size) == k) / self.held[k - self.parts["held"].start].sigma
        moved = np.array([one == path for one in self.paths], dtype=float)
        return np.append(np.linalg.solve(self.root, moved), np.zeros(self.size - len(moved)))

    def along(self, basis: np.ndarray) -> Parameters:
        """The same where the constants move along ``basis`` (n, k) alone, orthonormal directions of their part of x."""
        rest = slice(len(self.paths), self.size)
        return replace(self, root=self.root @ basis,
                       mean=np.concatenate([np.zeros(basis.shape[1]), self.mean[rest]]),
                       precision=np.concatenate([np.ones(basis.shape[1]), self.precision[rest]]))

    def values(self, x: np.ndarray) -> Sizes:
        """The effects' parameters, by cause."""
        found: Sizes = {(cls.name, at): {} for cls, at in self.hypothesis.effects}
        for coordinate, value in zip(self.coordinates, x[self.parts["effects"]], strict=True):
            found[coordinate.cause][coordinate.name] = coordinate.to_value(value)
        return found

    def rig_at(self, x: np.ndarray) -> Rig:
        """The rig that a parameter vector describes."""
        logs = np.clip(self.logs(x), -FARTHEST, FARTHEST)
        moved = dict(zip(self.paths, (self._nominal * np.exp(logs)).tolist(), strict=True))
        if self.back_emf:
            moved["motor.back_emf"] = self.back_emf_share(x)
        rig = self.rig.with_constants(moved).remeshed()
        own = list(self.rig.effects)
        for held, value in zip(self.held, x[self.parts["held"]], strict=True):
            own[held.effect] = own[held.effect].model_copy(update={held.name: held.value(value)})
        values = self.values(x)
        effects = [cls.model_construct(None, at=at, **cls.ordered(values[cls.name, at]))
                   for cls, at in self.hypothesis.effects]
        return rig.with_effects((*own, *effects)) if effects or self.held else rig

    @cached_property
    def _nominal(self) -> np.ndarray:
        nominal = self.rig.constants()
        return np.array([nominal[path] for path in self.paths])

    def back_emf_share(self, x: np.ndarray) -> float:
        """Of the motor's damping, as likely anywhere from none to all of it; where it is open (``back_emf``)."""
        return float(ndtr(x[self.parts["back_emf"].start]))

    def zero(self, x: np.ndarray, group: int) -> float:
        """Absolute angle (rad) of encoder count 0 in a group of runs that share it."""
        return float(x[self.parts["zeros"]][group - self.known_zeros]) if group in self.free_zeros else 0.0

    @property
    def free_zeros(self) -> range:
        """The groups of runs whose zero is unknown."""
        return range(self.known_zeros, self.known_zeros + self.zeros)

    def of_runs(self, zero_group: Sequence[int]) -> Iterator[list[tuple[int, int]]]:
        """(run, index in x) of the parameters that move some runs alone, kind by kind; a run has one of a kind."""
        zeros, places = self.parts["zeros"].start - self.known_zeros, self.parts["places"].start
        yield [(run, zeros + group) for run, group in enumerate(zero_group) if group in self.free_zeros]
        yield [(run, places + run) for run in range(self.gap_places)]

    def with_own_of(self, x: np.ndarray, other: np.ndarray, run: int, zero_group: Sequence[int]) -> np.ndarray:
        """The parameters ``x`` (p) with those that ``other`` (p) has for a run alone."""
        x = x.copy()
        for kind in self.of_runs(zero_group):
            moved = [k for _, k in kind]
            own = [k for r, k in kind if r == run and moved.count(k) == 1]
            x[own] = other[own]
        return x

    def place(self, x: np.ndarray, run: int) -> float:
        """Where in its gap the motor stands at a run's start, in [-1, 1]."""
        return math.tanh(x[self.parts["places"]][run]) if self.gap_places else 0.0

    def carried(self, other: Parameters, x: np.ndarray, start: Sizes | None = None) -> np.ndarray:
        """Another hypothesis' values in these parameters; what is new begins at ``start``, else at its prior mean."""
        logs = dict(zip(other.paths, other.logs(x), strict=True))
        out = self.placed(self.mean, np.array([logs.get(path, 0.0) for path in self.paths]))
        sizes = {**other.values(x), **(start or {})}
        for i, coordinate in enumerate(self.coordinates, self.parts["effects"].start):
            if coordinate.name in sizes.get(coordinate.cause, {}):
                out[i] = coordinate.to_x(sizes[coordinate.cause][coordinate.name])
        for part in ("zeros", "held", "back_emf", "places"):
            here, there = self.parts[part], other.parts[part]
            if here.stop - here.start == there.stop - there.start:
                out[here] = x[there]
        out[self.parts["held"]] /= self.wider(other)
        return out

    def wider(self, other: Parameters) -> np.ndarray:
        """(held) how many times as wide as in another hypothesis the priors are of what the rig file holds of effects.
        """
        return np.array([mine.sigma / its.sigma for mine, its in zip(self.held, other.held, strict=True)])

    def names(self) -> list[str]:
        """Names in the order of x: ``motor.gain``, ``coulomb_friction@motor.torque``."""
        return [*self.paths,
                *(f"{'@'.join(c.cause)}.{c.name}" for c in self.coordinates),
                *(f"encoder zero {group + 1}" for group in self.free_zeros),
                *(f"{self.rig.effects[h.effect].name}.{h.name}" for h in self.held),
                *["share of back-EMF"] * self.back_emf,
                *(f"place in the gap, run {k + 1}" for k in range(self.gap_places))]


def prior_covariance(rig: Rig, paths: Sequence[str]) -> np.ndarray:
    """Prior covariance (n, n) of constants' logarithms, positive definite: none is surer by itself than EXACT."""
    own = np.array([rig.sigma(path) for path in paths])
    return rig.log_covariance(list(paths)) + np.diag(np.maximum(EXACT**2 - own**2, 0.0))


def parameters(data: Dataset, hypothesis: Hypothesis, centres: Sizes, fixed: Collection[str] = ()) -> Parameters:
    """Parameters of a hypothesis; ``centres`` gives each effect's sizes, the centres of their priors.

    ``fixed``: constants that no fit moves.
    """
    rig = data.rig
    paths = tuple(path for path in rig.constants() if path not in fixed)
    covariance = prior_covariance(rig, paths)
    for i in (paths.index(path) for path in hypothesis.constants if path in paths):
        covariance[i, i] += WIDE**2
    mean, precision = [0.0] * len(paths), [1.0] * len(paths)
    coordinates = []
    for cls, at in hypothesis.effects:
        usual = cls.guesses(rig, at)
        for name, info in cls.parameters().items():
            value = centres[cls.name, at][name]
            coordinate = _coordinate((cls.name, at), name, info, value, [g[name] for g in usual],
                                     min(info.high, cls.largest(rig, at).get(name, math.inf)))
            coordinates.append(coordinate)
            if cls.stage is Stage.CLOCK:
                value, error = data.clock or (1.0, CLOCK_SIGMA)
                precision.append(((value if coordinate.log else coordinate.scale) / error) ** 2)
            else:
                precision.append((WIDE if coordinate.log else PHASE if info.periodic else PLACE) ** -2)
            mean.append(coordinate.to_x(value))
    known = int(all(effect.absolute is None for effect in rig.effects))
    shifted = known == 0 or any(cls.absolute is not None for cls, _ in hypothesis.effects)
    zeros = 1 + max(data.zero_groups) - known if shifted else 0
    held = tuple(one.free if one.path in hypothesis.constants else one for one in held_within(rig))
    stages = [*(effect.stage for effect in rig.effects), *(cls.stage for cls, _ in hypothesis.effects)]
    split = int(rig.drive is None and rig.motor.back_emf is None
                and any(cls.by_load(rig, at) for cls, at in hypothesis.effects))
    places = len(data.runs) if Stage.GAP in stages else 0
    mean += [0.0] * (zeros + len(held) + split + places)
    precision += [PLACE**-2] * zeros + [1.0] * (len(held) + split + places)
    return Parameters(rig, hypothesis, paths, np.linalg.cholesky(covariance), tuple(coordinates), known, zeros, held,
                      split, places, np.array(mean), np.array(precision))


def held_within(rig: Rig) -> tuple[Held, ...]:
    """What a rig file holds of effects within an uncertainty; what it states none of is exact."""
    return tuple(Held(k, name, f"{effect.name}.{name}", value, sigma, info.periodic)
                 for k, effect in enumerate(rig.effects) for (name, value), info in
                 zip(effect.values().items(), type(effect).parameters().values(), strict=True)
                 if (sigma := rig.uncertainty.get(f"{effect.name}.{name}", 0.0)) > 0.0
                 and (value != 0.0 or info.periodic))


def _coordinate(cause: Key, name: str, info: ParameterInfo, value: float, usual: Sequence[float],
                high: float) -> Coordinate:
    """How a fit moves one parameter, started from ``value``.

    Positive sizes by their logarithm; a size about a neutral value (a ratio about 1, a signed offset about 0) in units
    of its first guess; a place (a rest angle) in units of usual places; phases in rad.
    """
    neutral, origin, scale = info.neutral, 0.0, 1.0
    log = info.positive and not info.periodic and (neutral is None or neutral == 0.0 or math.isinf(neutral))
    if not log and not info.periodic:
        origin = neutral or 0.0
        least = min((abs(u - origin) for u in usual if u != origin), default=1.0)
        scale = max(abs(value - origin), least if neutral is None else 1e-6 * least)
    return Coordinate(cause, name, info, log, scale, high, origin)
