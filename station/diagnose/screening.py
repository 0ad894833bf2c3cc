"""Screening: what every cause would buy on top of a fitted hypothesis, to first order, alone and in pairs.

A cause of a guessed size changes the predictions; what that and multiples of it would buy, the parent's own parameters
moved with it, is read off the parent's quadratic (``linearised``).  With one of the parent's own effects taken out, and
what that changes taken from the errors, the same says which could stand in its place.

Where a rig sticks, or a law stands in a wave of the angle, a whole run changes by leaps: what is out of place by half a
wave, or is held by friction where it should not be, shows nothing of a torque.  Where sets are compared by what they
predict a few samples ahead (``Selection.judge``), causes are sought by that alone, too (``Linearised.ahead``): each
begins where it is expected to gain most.

What a law a sin(x + phi) changes is, to first order, that of two phases a quarter of a turn apart, cos(phi) of one and
sin(phi) of the other: both sizes together say amplitude and phase.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from station.diagnose.candidates import Candidate
from station.diagnose.linearised import Change, Linearised, Weighed
from station.estimation.cause import Key, Sizes
from station.estimation.fitted import Fit
from station.estimation.least_squares import DIVERGED
from station.estimation.parameters import parameters
from station.estimation.prediction import Predictor
from station.estimation.spread import shared
from station.model.effects import Stage

LINEAR = 3.0
"""Multiple of a guess up to which the first order is believed; beyond it the gain grows in proportion only."""
STRONG = 100.0
"""Information of a guess (its size over the error's, squared) from which on a smaller one is looked at, too."""
BIAS = ("command_bias", "amplifier")
"""The cause that is what runs may have of their own, where all have the same of it."""
PAIRED = 8
"""Causes that are looked at in pairs: those expected to gain most."""


@dataclass(frozen=True)
class Screened:
    """What screening says of a cause at one guess."""

    candidate: Candidate
    guess: dict[str, float]
    gain: float
    """Expected fall of -2 ln L."""
    size: float
    """Multiple of the guess that gives it."""
    information: float
    """Fall that the guess itself would make visible."""
    shared: float = 0.0
    """Counts of command that the parent took for what runs differ by, and this cause for what they share."""

    @property
    def start(self) -> Sizes:
        """Sizes from which a fit begins, within bounds."""
        return {self.candidate.key: self.candidate.sized(self.guess, min(max(self.size, 1e-3), 5.0))}


@dataclass(frozen=True, eq=False)
class _Row:
    """What screening says of a guess, what so many times the guess and its components change in the predictions, and
    how many times."""

    screened: Screened
    guess: dict[str, float]
    """The first component."""
    changes: tuple[Change, ...]
    """Of every component (``Candidate.components``); none where the guess does not simulate."""
    factor: float = 1.0

    def along(self, sizes: np.ndarray, gain: float) -> Screened:
        """The same cause where its components have these sizes (m)."""
        return replace(self.screened, guess=turned(self.screened.candidate, self.guess, sizes), gain=gain,
                       size=self.factor * math.hypot(*sizes))


def turned(candidate: Candidate, guess: dict[str, float], sizes: np.ndarray) -> dict[str, float]:
    """A guess in the phase that its components' sizes (m) say."""
    phase = candidate.phase
    if phase is None:
        return guess
    return {**guess, phase: math.remainder(guess[phase] + math.atan2(sizes[1], sizes[0]), math.tau)}


def _direction(gram: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """(m) by which shares of its components, whose squares add up to one, a cause buys most; G (m, m) and b (m)."""
    if len(slope) == 1:
        return np.ones(1)
    sizes = np.linalg.lstsq(gram, slope, rcond=1e-9)[0]
    length = float(np.linalg.norm(sizes))
    return sizes / length if length > 0.0 else np.eye(len(slope))[0]


def screen(predictor: Predictor, parent: Fit, pool: Sequence[Candidate],
           ) -> tuple[list[Screened], list[tuple[Screened, Screened]], dict[Key, list[Screened]]]:
    """All causes at their guesses, best first; pairs expected to gain more than their better half, best first; and by
    each of the parent's effects what could stand in its place, best first."""
    known = Linearised.of(predictor, parent)

    def row(candidate: Candidate, guesses: Sequence[dict[str, float]], factor: float = 1.0) -> _Row:
        found = [known.change(*candidate.beside(predictor.data, parent, candidate.sized(guess, factor)))
                 for guess in guesses]
        changes = tuple(change for change in found if change is not None)
        if len(changes) < len(found):
            return _Row(Screened(candidate, guesses[0], 0.0, 1.0, 0.0), guesses[0], ())
        return _Row(_expected(known, candidate, guesses[0], changes), guesses[0], changes, factor)

    def tried(task: tuple[Candidate, tuple[dict[str, float], ...]]) -> _Row:
        candidate, guesses = task
        found = row(candidate, guesses)
        strength = found.screened.information
        if strength > STRONG:
            closer = row(candidate, guesses, factor := math.sqrt(STRONG / strength))
            if closer.changes and closer.screened.gain > found.screened.gain:
                return replace(closer, screened=replace(closer.screened, size=factor * closer.screened.size,
                                                        information=strength))
        return found

    rows = list(predictor.pool.map(tried, [(c, guesses) for c in pool for guesses in c.components]))
    found = [row.screened for row in rows]
    clock, quadratic = predictor.data.clock, parent.normal(parent.weighing)
    for candidate in pool:
        if candidate.effect is None:
            found.append(freed(predictor, parent, candidate, *quadratic))
        elif candidate.effect.stage is Stage.CLOCK and clock is not None:
            ratio, error = clock
            found.append(Screened(candidate, {"ratio": ratio}, ((ratio - 1.0) / error) ** 2, 1.0,
                                  max(abs(math.log(guess["ratio"])) for guess in candidate.guesses) ** 2 / error**2))
    found += _shared(parent, pool)
    rows = [row for row in rows if row.changes]
    return sorted(found, key=lambda s: -s.gain), _pairs(known, rows), _in_place(known, rows)


def _shared(parent: Fit, pool: Sequence[Candidate]) -> list[Screened]:
    """A bias that all runs share, where the parent let every run have its own.

    From the predictions this is not seen: they stay as they are.
    """
    constants = parent.own[:, 3]
    mean, gain = float(np.mean(constants)), shared(constants)
    if not math.isfinite(gain):
        return []
    return [Screened(c, {"offset": mean}, gain, 1.0, 0.0, mean) for c in pool if c.key == BIAS]


def _expected(known: Linearised, candidate: Candidate, first: dict[str, float], changes: Sequence[Change]) -> Screened:
    """What a cause is expected to gain, its components in the best proportion: the most of two quadratics that give no
    more than the likelihood, and of that of what is predicted a few samples ahead."""
    def by(weighed: Weighed) -> tuple[Screened, np.ndarray, float]:
        gram, slope = weighed.products(list(changes))
        sizes = _direction(gram, slope)
        said = _screened(candidate, turned(candidate, first, sizes), float(sizes @ gram @ sizes), float(slope @ sizes))
        return said, sizes, float(gram.diagonal().max())

    (found, sizes, information), *ahead = map(by, known.weighings)
    tried = [found, *(said for said, _, _ in ahead)]
    beyond = known.beyond(Change.combined(changes, sizes))
    if beyond is not None:
        fall, s, b = beyond
        other = _screened(candidate, found.guess, s, b)
        if other.size > 0.0:
            tried.append(replace(other, gain=fall + other.gain))
    return replace(max(tried, key=lambda one: one.gain), information=information)   # it shows if it does in any phase


def _screened(candidate: Candidate, guess: dict[str, float], s: float, b: float) -> Screened:
    if s <= 1e-9:
        return Screened(candidate, guess, 0.0, 1.0, max(s, 0.0))
    size = b / s
    gain = 0.0 if size <= 0.0 else s * (2.0 * LINEAR * size - LINEAR**2) if size > LINEAR else b * b / s
    return Screened(candidate, guess, gain, size, s)


def _pairs(known: Linearised, rows: Sequence[_Row]) -> list[tuple[Screened, Screened]]:
    """Pairs of causes whose sizes, fitted together, buy more than any single one: first what buys most more, by any of
    the quadratics; of pairs that are alike, cause by cause, the first.

    Where nothing sticks yet a friction shows with what it will hide.
    """
    best: dict[Key, _Row] = {}
    for row in sorted(rows, key=lambda row: -row.screened.gain):
        if row.screened.information > 1e-6 and row.screened.size > 0.0:
            best.setdefault(row.screened.candidate.key, row)
    leading = list(best.values())[:PAIRED]
    if len(leading) < 2:
        return []
    ends = np.cumsum([len(row.changes) for row in leading])
    columns = np.split(np.arange(ends[-1]), ends[:-1])
    found: list[tuple[float, tuple[Screened, Screened]]] = []
    for weighed in known.weighings:
        quadratic = weighed.products([change for row in leading for change in row.changes])
        most = max(_bought(*quadratic, [part])[0] for part in columns)
        for (one, mine), (other, its) in combinations(zip(leading, columns, strict=True), 2):
            gain, sizes = _bought(*quadratic, [mine, its])
            if gain > most and not one.screened.candidate.alike(other.screened.candidate):
                found.append((gain - most, (one.along(sizes[0], gain), other.along(sizes[1], gain))))
    pairs: list[tuple[Screened, Screened]] = []
    for _, pair in sorted(found, key=lambda one: -one[0]):
        if not any(_alike(pair, old) for old in pairs):
            pairs.append(pair)
    return pairs


def _alike(pair: tuple[Screened, Screened], other: tuple[Screened, Screened]) -> bool:
    """Whether each cause of a pair is one of another pair's, or a case of it."""
    return any(all(a.candidate.alike(b.candidate) for a, b in zip(pair, order, strict=True))
               for order in (other, other[::-1]))


def _bought(gram: np.ndarray, slope: np.ndarray, parts: Sequence[np.ndarray]) -> tuple[float, list[np.ndarray]]:
    """What causes of these components (columns of G and b) buy together, and their sizes; nothing where one would have
    to be its own opposite, or larger than the first order is believed."""
    together = np.concatenate(parts)
    sizes = np.linalg.lstsq(gram[np.ix_(together, together)], slope[together], rcond=1e-12)[0]
    each = np.split(sizes, np.cumsum([len(part) for part in parts])[:-1])
    within = all(np.linalg.norm(size) < LINEAR and (len(size) > 1 or size[0] > 0.0) for size in each)
    return float(slope[together] @ sizes) if within else 0.0, each


def _in_place(known: Linearised, rows: Sequence[_Row]) -> dict[Key, list[Screened]]:
    """What could stand in the place of each effect of a parent; of a single one the same law elsewhere alone, for the
    others were looked at before."""
    space, hypothesis, data = known.parent.space, known.parent.space.hypothesis, known.predictor.data
    found: dict[Key, list[Screened]] = {}
    for less in [(cls.name, at) for cls, at in hypothesis.effects]:
        with suppress(*DIVERGED):
            reduced = known.without(parameters(data, hypothesis.without(less), space.values(space.mean)))
            others: dict[Key, Screened] = {}
            for row in rows:
                key = row.screened.candidate.key
                if key[0] == less[0] or len(hypothesis.causes) > 1:
                    gram, slope = reduced.weighed.products(list(row.changes))
                    sizes = _direction(gram, slope)
                    one = _screened(row.screened.candidate, turned(row.screened.candidate, row.guess, sizes),
                                    float(sizes @ gram @ sizes), float(slope @ sizes))
                    if key not in others or one.gain > others[key].gain:
                        others[key] = replace(one, size=row.factor * one.size)
            found[less] = sorted(others.values(), key=lambda one: -one.gain)
    return found


def freed(predictor: Predictor, parent: Fit, candidate: Candidate, normal: np.ndarray, slope: np.ndarray) -> Screened:
    """Expected gain of setting one constant free: only its prior changes.

    ``normal`` (p, p) and ``slope`` (p): the data's, of the parent.
    """
    base, n = parent.space, len(parent.space.paths)
    space, x = candidate.beside(predictor.data, parent, {})
    transform = np.eye(base.size)
    transform[:n, :n] = np.linalg.solve(base.root, space.root)
    held = np.arange(base.size)[base.parts["held"]]
    transform[held, held] = space.wider(base)

    def cost(prior: np.ndarray, matrix: np.ndarray, slope: np.ndarray, at: np.ndarray) -> float:
        force = slope - prior * (at - base.mean)
        return float(prior @ (at - base.mean) ** 2 - force @ np.linalg.solve(matrix + np.diag(prior), force))

    before = cost(base.precision, normal, slope, parent.x)
    after = cost(space.precision, transform.T @ normal @ transform, transform.T @ slope, x)
    return Screened(candidate, {}, max(before - after, 0.0), 1.0, float(np.trace(normal)))
