"""Screening: what every cause would buy on top of a fitted hypothesis, to first order, alone and in pairs.

With D what a cause of a guessed size changes in the predictions, weighed as the errors e are, and the parent's own
parameters and nuisances eliminated, G = D'D and b = D'e: causes of sizes a = G^-1 b lower -2 ln L by b'G^-1 b.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from station.diagnose.candidates import Candidate
from station.estimation.dataset import SEVERAL
from station.estimation.least_squares import Fit
from station.estimation.parameters import Parameters, Sizes, parameters
from station.estimation.prediction import Predictor
from station.model.effects import Stage

LINEAR = 3.0
"""Multiple of a guess up to which the first order is believed; beyond it the gain grows in proportion only."""
STRONG = 100.0
"""Information of a guess (its size over the error's, squared) from which on a smaller one is looked at, too."""
BIAS = ("command_bias", "amplifier")
"""The cause that is what runs may have of their own, where all have the same of it."""
PAIRED = 8
"""Causes that are looked at in pairs: those that promise most."""


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
        return {self.candidate.key: scaled(self.candidate, self.guess, min(max(self.size, 1e-3), 5.0))}

    @property
    def centre(self) -> Sizes:
        """Sizes at which the prior is centred."""
        return {self.candidate.key: self.guess}


def scaled(candidate: Candidate, guess: dict[str, float], factor: float) -> dict[str, float]:
    """A guess so many times its distance from neutral, within bounds."""
    if candidate.effect is None:
        return {}
    moved, infos = {}, candidate.effect.parameters()
    for name, value in guess.items():
        info = infos[name]
        if info.neutral is None or not math.isfinite(info.neutral) or info.periodic:
            moved[name] = value
            continue
        moved[name] = min(max(info.neutral + factor * (value - info.neutral), info.low), info.high)
    return moved


class _Eliminated:
    """A parent's weighed errors and derivatives, and inner products with both taken out."""

    def __init__(self, predictor: Predictor, parent: Fit) -> None:
        assert parent.jacobian is not None
        self.predictor, self.parent = predictor, parent
        p, w = parent.space.size, parent.blocks(parent.weighing)
        self.roots = [np.sqrt(row)[:, None] for row in w]
        self.derivatives = [(j * root).reshape(len(j), -1) for j, root in zip(parent.jacobian, self.roots, strict=True)]
        self.errors = [(e * root).ravel() for e, root in zip(parent.residuals, self.roots, strict=True)]
        self.scale = [predictor.scale(r) for r in range(len(w))]
        normal, slope = parent.normal(parent.weighing)
        self.matrix = normal + np.diag(parent.space.precision)
        self.force = slope - parent.space.precision * (parent.x - parent.space.mean)
        # Per run: the nuisances' own products, and what of errors and parameters they take up.
        self.inner = [np.linalg.inv(d[p:] @ d[p:].T + np.diag(own))
                      for d, own in zip(self.derivatives, parent.nuisance, strict=True)]
        self.coupled = [d[p:] @ d[:p].T for d in self.derivatives]
        self.taken = [d[p:] @ e - own * away for d, e, own, away in
                      zip(self.derivatives, self.errors, parent.nuisance, parent.away, strict=True)]

    def change(self, space: Parameters, x: np.ndarray) -> list[np.ndarray] | None:
        """What a hypothesis at x changes in the weighed predictions, per run; None where it does not simulate."""
        predicted = self.predictor.runs(space, x, self.parent.own)
        found = [((new - old) * s * root).ravel() for new, old, s, root in
                 zip(predicted, self.parent.predicted, self.scale, self.roots, strict=True)]
        return found if all(np.all(np.isfinite(f)) for f in found) else None

    def products(self, changes: Sequence[list[np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
        """G (k, k) and b (k) of changes."""
        k, p = len(changes), self.parent.space.size
        gram, slope, cross = np.zeros((k, k)), np.zeros(k), np.zeros((p, k))
        for r, (d, e) in enumerate(zip(self.derivatives, self.errors, strict=True)):
            c = np.stack([change[r] for change in changes])
            both = d @ c.T
            solved = self.inner[r] @ np.column_stack([both[p:], self.taken[r]])
            gram += c @ c.T - both[p:].T @ solved[:, :-1]
            slope += c @ e - both[p:].T @ solved[:, -1]
            cross += both[:p] - self.coupled[r].T @ solved[:, :-1]
        taken = np.linalg.solve(self.matrix, np.column_stack([cross, self.force]))
        return gram - cross.T @ taken[:, :-1], slope - cross.T @ taken[:, -1]


def screen(predictor: Predictor, parent: Fit, pool: Sequence[Candidate],
           ) -> tuple[list[Screened], list[tuple[Screened, Screened]]]:
    """All causes at their guesses, best first, and pairs that promise more than their better half, best first."""
    known = _Eliminated(predictor, parent)

    def at(candidate: Candidate, guess: dict[str, float]) -> list[np.ndarray] | None:
        hypothesis = parent.space.hypothesis + candidate.hypothesis
        centres = {**parent.space.values(parent.space.mean), candidate.key: guess}
        space = parameters(predictor.data, hypothesis, centres)
        x = space.carried(parent.space, parent.x, {candidate.key: guess})
        return known.change(space, x)

    def tried(task: tuple[Candidate, dict[str, float]]) -> tuple[Screened, list[np.ndarray] | None]:
        candidate, guess = task
        change = at(candidate, guess)
        if change is None:
            return Screened(candidate, guess, 0.0, 1.0, 0.0), None
        gram, slope = known.products([change])
        found = _screened(candidate, guess, float(gram[0, 0]), float(slope[0]))
        if found.information > STRONG:
            factor = math.sqrt(STRONG / found.information)
            smaller = at(candidate, scaled(candidate, guess, factor))
            if smaller is not None:
                gram, slope = known.products([smaller])
                closer = _screened(candidate, guess, float(gram[0, 0]), float(slope[0]))
                if closer.gain > found.gain:
                    return replace(closer, size=factor * closer.size, information=found.information), smaller
        return found, change

    tasks = [(c, g) for c in pool if c.effect is not None for g in c.guesses]
    rows = list(predictor.pool.map(tried, tasks))
    found = [screened for screened, _ in rows]
    clock = predictor.data.clock
    for candidate in pool:
        if candidate.effect is None:
            found.append(_freed(predictor, parent, candidate, known))
        elif candidate.effect.stage is Stage.CLOCK and clock is not None:
            ratio, error = clock
            found.append(Screened(candidate, {"ratio": ratio}, ((ratio - 1.0) / error) ** 2, 1.0, error**-2))
    found += _shared(parent, pool)
    return sorted(found, key=lambda s: -s.gain), _pairs(known, rows)


def _shared(parent: Fit, pool: Sequence[Candidate]) -> list[Screened]:
    """A bias that all runs share, where the parent let every run have its own.

    R constants a_r, normal about a mean m instead of about 0, are more likely by 2 ln L = R ln(sum a^2/sum (a - m)^2),
    each by its own most likely spread.  From the predictions this is not seen: they stay as they are.
    """
    constants = parent.own[:, 3]
    mean, spread = float(np.mean(constants)), float(np.var(constants))
    if len(constants) < SEVERAL or spread <= 0.0:
        return []
    gain = len(constants) * math.log1p(mean * mean / spread)
    return [Screened(c, {"offset": mean}, gain, 1.0, 0.0, mean) for c in pool if c.key == BIAS]


def _screened(candidate: Candidate, guess: dict[str, float], s: float, b: float) -> Screened:
    if s <= 1e-9:
        return Screened(candidate, guess, 0.0, 1.0, max(s, 0.0))
    size = b / s
    gain = 0.0 if size <= 0.0 else s * (2.0 * LINEAR * size - LINEAR**2) if size > LINEAR else b * b / s
    return Screened(candidate, guess, gain, size, s)


def _pairs(known: _Eliminated, rows: Sequence[tuple[Screened, list[np.ndarray] | None]],
           ) -> list[tuple[Screened, Screened]]:
    """Pairs of causes whose sizes, fitted together, buy more than the better of the two and another cause's worth."""
    best: dict[tuple[str, str], tuple[Screened, list[np.ndarray]]] = {}
    for screened, change in sorted(rows, key=lambda row: -row[0].gain):
        if change is not None and screened.information > 1e-6 and screened.size > 0.0:
            best.setdefault(screened.candidate.key, (screened, change))
    leading = list(best.values())[:PAIRED]
    if len(leading) < 2:
        return []
    gram, slope = known.products([change for _, change in leading])
    found = []
    for i, j in combinations(range(len(leading)), 2):
        part = np.ix_([i, j], [i, j])
        try:
            sizes = np.linalg.solve(gram[part], slope[[i, j]])
        except np.linalg.LinAlgError:
            continue
        if np.all(sizes > 0.0) and np.all(sizes < LINEAR):
            found.append((float(slope[[i, j]] @ sizes), i, j, sizes))
    pairs = []
    for gain, i, j, sizes in sorted(found, key=lambda row: -row[0]):
        one, other = leading[i][0], leading[j][0]
        if gain > max(one.gain, other.gain):
            first, second = (float(size) for size in sizes)
            pairs.append((replace(one, gain=gain, size=first), replace(other, gain=gain, size=second)))
    return pairs


def _freed(predictor: Predictor, parent: Fit, candidate: Candidate, known: _Eliminated) -> Screened:
    """Expected gain of setting one constant free: only its prior changes."""
    base = parent.space
    space = parameters(predictor.data, base.hypothesis + candidate.hypothesis, base.values(base.mean))
    n = len(base.paths)
    transform = np.eye(base.size)
    transform[:n, :n] = np.linalg.solve(base.root, space.root)
    normal, slope = parent.normal(parent.weighing)
    x = space.carried(base, parent.x)

    def cost(prior: np.ndarray, matrix: np.ndarray, slope: np.ndarray, at: np.ndarray) -> float:
        force = slope - prior * (at - base.mean)
        return float(prior @ (at - base.mean) ** 2 - force @ np.linalg.solve(matrix + np.diag(prior), force))

    before = cost(base.precision, normal, slope, parent.x)
    after = cost(space.precision, transform.T @ normal @ transform, transform.T @ slope, x)
    return Screened(candidate, {}, max(before - after, 0.0), 1.0, float(np.trace(normal)))
