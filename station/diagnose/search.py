"""Searching the causes: screen all, fit the promising, climb one cause at a time, look back.

Screening linearises about the parent's fit: with D what a candidate of a guessed size changes in the outputs, and the
parent's own parameters and nuisances eliminated, the fall of chi^2 is b^2/s at the size a = b/s, s = D'D and b = D'e
after elimination.  The most promising are fitted: all quickly, the best of these and the most promised further, the
best of these to the end.  Every fitted set of causes is kept; probabilities come from all of them together (see
posterior).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from station.control.compensators import commanded
from station.diagnose.candidates import Candidate, candidates
from station.diagnose.estimate import LOST, REACHED, Fit, eliminate, fit, go_on, nuisance_priors
from station.diagnose.problem import FINE, MISFIT, QUICK, ROUGH, Hypothesis, Layout, Problem
from station.diagnose.remainder import remainder
from station.model.effects import Stage

LOG_PRIOR = -7.0
"""Log prior odds that any one further cause is present, about one in a thousand: a false alarm costs a lab more than
one more test."""
LOG_PRIOR_PARAMETER = -2.5
"""Each further parameter of one effect, beside what the evidence itself asks of it: a law that holds a simpler one must
earn its parameters."""

STRAINED = 60.0
"""What the constants' distances from nominal may cost, of some 15 that are right 15 on average; beyond it a search may
have gone astray.  Where a second effect is missing they cost less (8 to 47 in six pairs); a constant that is missing,
or an effect that the catalogue lacks, may strain them as much (16 to 383 in four rigs)."""
HORIZONS = (0.1, 0.3, 1.0)
"""Seconds from where the command first moves, over which a fit that went astray is begun anew, one after the other."""
FAR = (-2.0, 1.5, 3.0)
"""Logarithms of a constant over nominal at which it is held while the others are fitted, before it is set free."""
CLOSE = 150.0
"""Twice a log posterior within which two hypotheses are close rivals."""
HOPELESS = (100.0, 10.0)
"""Variance of what is left after one cause and after two, over the noise's, from which on driving by command is given
up."""
LITTLE = 0.1
"""Share of that variance which one cause must take off where more than the second is left."""
RETURNS, NEAR = 1, 1.25
"""How often a search that ends with more than noise goes back to a set it had passed over, and the chi^2 of that set
over that of the one it had climbed from: what is no noise says little of which is right.  What begins anew is followed
as far."""
BOLD = 100.0
"""What a guess may change in all outputs together, standard deviations; of one that changes more a smaller one is
screened, too, for laws are linear in small sizes alone."""
LEAST, MOST = (0.2, 1e-4), 5.0
"""Least share of a guess at which its prior is centred, and from which a fit begins; the most of both."""
SWAPS = 3
"""Rivals that are tried in the place of a cause of the best set."""
PROMISED = 3
"""Starts that screening promised most of, which are fitted further wherever their quick fit ended."""
HALFWAY = 3.0
"""Fall of a fit's objective per step at which the promising are compared once more."""
CARE: dict[str, Any] = {"tolerance": 0.1}
MISFIT_CARE: dict[str, Any] = {"tolerance": 1.0, "renewals": 2}
"""How far fits go, and where no set reaches the noise: there errors on unseen runs decide, not parts of chi^2."""


@dataclass(frozen=True)
class Effort:
    """How far a search goes."""

    fits: int
    """Candidates fitted on each rung."""
    exact: int
    """Of these, how many are fitted to the end."""
    rungs: int
    """Most causes in one hypothesis."""
    thorough: bool
    """Whether also to follow what looks lost (starts that were promised more than they gave, fits that are worse than
    their parent), to fit rivals again from the best's constants, to look for more where only noise is left, and to take
    held-out fits to the end."""


EFFORTS = {"quick": Effort(8, 2, 2, False), "full": Effort(14, 4, 3, True)}


@dataclass
class Promise:
    """What screening says of a candidate."""

    candidate: Candidate
    guess: dict[str, float]
    gain: float
    """Predicted fall of chi^2."""
    size: float
    """Multiple of the guess that gives it."""
    information: float
    """chi^2 that the guess itself would make visible."""


@dataclass
class Search:
    """The state of a search: all fits by their set of causes."""

    problem: Problem
    effort: Effort
    progress: Callable[[str, float], None] = lambda text, share: None
    fits: dict[frozenset[tuple[str, str]], Fit] = field(default_factory=dict)
    promises: list[Promise] = field(default_factory=list)
    """Of the first rung."""
    refuted: set[frozenset[tuple[str, str]]] = field(default_factory=set)
    """Sets of causes that runs left out speak against."""

    @property
    def care(self) -> dict[str, Any]:
        """How far fits go."""
        return CARE if self.problem.by_command or not self.misfit else MISFIT_CARE

    @property
    def misfit(self) -> bool:
        """Whether even the best leaves more than noise; then what it predicts of unseen runs decides."""
        least = min(found.chi2 for found in self.fits.values())
        return bool(np.any(self.problem.temper > 1.0)) or least > MISFIT * float(self.problem.samples.sum())

    def temperature(self) -> float:
        """Scale of what the best hypothesis leaves, 1 where it reaches the noise."""
        return max(1.0, min(f.chi2 for f in self.fits.values()) / float(self.problem.samples.sum()))

    def hopeless(self, rung: int, before: float) -> bool:
        """Whether further causes are not worth trying by command; ``before``: temperature without causes."""
        left, (much, still_much) = self.temperature(), HOPELESS
        return left > (much if rung == 0 else still_much) or left > max(still_much, (1.0 - LITTLE) * before)

    def score(self, found: Fit, temperature: float) -> float:
        """Log posterior of a set of causes, up to a constant."""
        hypothesis = found.layout.hypothesis
        further = sum(len(cls.parameters()) - 1 for cls, _ in hypothesis.effects) + found.layout.zeros
        score = (found.log_evidence(temperature) + LOG_PRIOR * len(hypothesis.causes())
                 + LOG_PRIOR_PARAMETER * further + self.clock_score(hypothesis))
        return score if math.isfinite(score) else -math.inf

    def clock_score(self, hypothesis: Hypothesis) -> float:
        """What the clocks' own comparison says against a hypothesis that leaves the board's clock right."""
        clock = self.problem.clock
        if clock is None or any(cls.stage is Stage.CLOCK for cls, _ in hypothesis.effects):
            return 0.0
        return -0.5 * ((clock[0] - 1.0) / clock[1]) ** 2

    def best(self) -> Fit:
        """The set of causes with the highest posterior."""
        temperature = self.temperature()
        return max(self.fits.values(), key=lambda f: self.score(f, temperature))

    def keep(self, found: Fit) -> None:
        """Remember a fit; of the same causes the better one."""
        key = frozenset(found.layout.hypothesis.causes())
        if key not in self.fits or found.objective < self.fits[key].objective:
            self.fits[key] = found


def base_fit(problem: Problem) -> Fit:
    """The best rig without further causes; in closed loops sets the noise that rounding feeds back on the way."""
    layout = problem.layout(Hypothesis(), {})
    samples = problem.samples.sum()
    found = fit(problem, layout, layout.prior_mean.copy(), tolerance=2.0)
    if problem.by_command:
        for another in (_grown, _closed_first):
            if found.chi2 > REACHED * samples:
                with suppress(*LOST):    # went where nothing simulates; what there is stands
                    found = min(found, another(problem, layout), key=lambda f: f.objective)
        if found.chi2 < REACHED * samples:
            found = fit(problem, layout, found.x, found.start, found.offset, jacobian=found.jacobian)
        return found
    problem.calibrate(layout, found.x, found.start, found.offset)
    found = fit(problem, layout, found.x, found.start, found.offset)
    if found.chi2 > MISFIT * samples:
        problem.weigh(found.residuals)
        found = fit(problem, layout, found.x, found.start, found.offset, tolerance=2.0,
                    jacobian=found.jacobian_at(problem.scale))
    return found


def _begun(beginnings: list[Problem], layout: Layout, parallel: bool) -> Fit:
    """A fit of longer and longer starts of the runs: vibrations that later are off by whole periods are not yet so."""
    x, start, offset = layout.prior_mean.copy(), None, None
    for beginning in beginnings:
        found = fit(beginning, layout, x, start, offset, tolerance=10.0, parallel=parallel)
        x, start, offset = found.x, found.start, found.offset
    return found


def _grown(problem: Problem, layout: Layout) -> Fit:
    """A fit begun on the start of the runs."""
    begun = _begun([problem.beginning(seconds) for seconds in HORIZONS], layout, parallel=True)
    return fit(problem, layout, begun.x, begun.start, begun.offset, tolerance=2.0)


def _closed_first(problem: Problem, layout: Layout) -> Fit:
    """A fit begun where one of closed loops ends: a controller keeps a poor model near the data."""
    problem.by_command = False
    try:
        begun = fit(problem, layout, layout.prior_mean.copy(), tolerance=10.0)
    finally:
        problem.by_command = True
    return fit(problem, layout, begun.x, begun.start, begun.offset, tolerance=2.0)


def begun_anew(search: Search, pool: list[Candidate]) -> None:
    """Fit single causes, begun on the start of the runs with the rig's nominal constants; the likeliest to the end.

    One constant that is many sigma off, or an effect for which the constants together make up, leads a fit of whole
    runs to constants about which screening says little.  On the start of the runs effects are screened, and each
    constant is set free, also from far values to which the others were fitted first.
    """
    problem = search.problem
    first, early, longer = (problem.beginning(seconds) for seconds in HORIZONS)
    base = problem.layout(Hypothesis(), {})
    try:
        begun = _begun([first], base, parallel=True)
        nothing = fit(early, base, begun.x, begun.start, begun.offset, tolerance=2.0)
    except LOST:                 # went where nothing simulates
        return

    def freed(start: tuple[Fit, Candidate]) -> Fit | None:
        found, candidate = start
        with suppress(*LOST):
            layout = problem.layout(candidate.hypothesis, {})
            return fit(early, layout, _carried(found, layout, []), found.start, found.offset, tolerance=2.0,
                       parallel=False, iterations=6)
        return None

    def held(task: tuple[Candidate, float]) -> Fit | None:
        """The others fitted while one constant is held far off; given up where they do not make up for it at all."""
        candidate, far = task
        shift = np.zeros(len(base.paths))
        shift[base.paths.index(candidate.hypothesis.constants[0])] = far
        mean = base.prior_mean.copy()
        mean[: len(shift)] += np.linalg.solve(base.root, shift)
        with suppress(*LOST):
            layout = replace(base, prior_mean=mean)
            found = fit(first, layout, mean, tolerance=10.0, parallel=False, iterations=15)
            if found.objective < begun.objective + CLOSE:
                return fit(early, layout, found.x, found.start, found.offset, tolerance=10.0, parallel=False,
                           iterations=6)
        return None

    def joined(promise: Promise) -> Fit | None:
        layout, x = child_layout(early, nothing, promise.candidate, *started(promise))
        with suppress(*LOST):
            return fit(early, layout, x, nothing.start, nothing.offset, jacobian=child_jacobian(nothing, layout),
                       tolerance=2.0, parallel=False, iterations=10)
        return None

    def further(on: Problem) -> Callable[[Fit], Fit | None]:
        def one(found: Fit) -> Fit | None:
            with suppress(*LOST):
                return fit(on, found.layout, found.x, found.start, found.offset, iterations=40, tolerance=2.0,
                           parallel=False)
            return None
        return one

    promises: dict[tuple[str, str], Promise] = {}
    for promise in screen(early, nothing, [c for c in pool if c.effect is not None]):
        promises.setdefault(promise.candidate.key, promise)
    fitted = list(problem.pool.map(joined, list(promises.values())[: 2 * PROMISED]))
    constants = [c for c in pool if c.effect is None]
    tasks = [(c, far) for c in constants for far in FAR]
    starts = sorted(((f, c) for f, (c, _) in zip(problem.pool.map(held, tasks), tasks, strict=True) if f is not None),
                    key=lambda row: row[0].objective)[: 2 * PROMISED]
    starts += [(nothing, c) for c in constants]
    fitted += problem.pool.map(freed, starts)
    for on, most in ((longer, 2 * PROMISED), (problem, PROMISED)):
        likeliest: dict[frozenset[tuple[str, str]], Fit] = {}
        ranked = sorted((f for f in fitted if f is not None), key=lambda f: f.objective)
        for found in ranked:
            if found.objective < NEAR * ranked[0].objective:
                likeliest.setdefault(frozenset(found.layout.hypothesis.causes()), found)
        fitted = list(problem.pool.map(further(on), list(likeliest.values())[:most]))
    for found in fitted:
        if found is not None:
            search.keep(found)


def child_layout(problem: Problem, parent: Fit, candidate: Candidate, guess: dict[str, float],
                 start: dict[str, float] | None = None) -> tuple[Layout, np.ndarray]:
    """Layout and start of a parent's hypothesis with one more cause; it begins at ``guess``, or at ``start``."""
    base = parent.layout
    hypothesis = base.hypothesis + candidate.hypothesis
    sizes = _sizes(base, base.prior_mean)
    if candidate.effect is not None:
        sizes[len(hypothesis.effects) - 1] = guess
    layout = problem.layout(hypothesis, sizes)
    inherited = len(base.coordinates)
    x = _carried(parent, layout, list(range(inherited)))
    if start:
        for i, coordinate in enumerate(layout.coordinates[inherited:], len(base.paths) + inherited):
            x[i] = coordinate.to_x(start[coordinate.name])
    return layout, x


def _carried(found: Fit, layout: Layout, kept: list[int]) -> np.ndarray:
    """A fit's values in another layout, whose first coordinates are these of its own; new ones at their prior mean."""
    old, n = found.layout, len(layout.paths)
    x = layout.prior_mean.copy()
    x[:n] = np.linalg.solve(layout.root, found.logs)
    for i, k in enumerate(kept):
        x[n + i] = layout.coordinates[i].to_x(old.coordinates[k].to_value(found.x[n + k]))

    def tails(of: Layout) -> tuple[slice, slice]:
        """Where the zeros are, and the places in the gaps."""
        gaps = of.size - of.gap_places
        return slice(gaps - of.zeros, gaps), slice(gaps, of.size)
    for here, there in zip(tails(layout), tails(old), strict=True):
        if here.stop - here.start == there.stop - there.start:
            x[here] = found.x[there]
    return x


def child_jacobian(parent: Fit, layout: Layout) -> list[np.ndarray]:
    """The parent's derivatives by the constants and nuisances, in a child's coordinates; the effects' are left 0."""
    base, n = parent.layout, len(layout.paths)
    transform = np.linalg.solve(base.root, layout.root)
    return [np.concatenate([transform.T @ j[:n], np.zeros((layout.size - n, j.shape[1])), j[base.size:]])
            for j in parent.jacobian]


def screen(problem: Problem, parent: Fit, pool: list[Candidate]) -> list[Promise]:
    """Predicted gains of all candidates at their guesses on top of a fitted hypothesis, best first."""
    count = parent.layout.size
    normal, gradient, back = eliminate(problem, parent.start, parent.offset, parent.residuals, parent.jacobian, count)
    scale = max(parent.chi2 / float(problem.samples.sum()), 1.0)
    matrix = normal.sum(axis=0) / scale + np.diag(parent.layout.prior_precision)
    force = gradient.sum(axis=0) / scale - parent.layout.prior_precision * (parent.x - parent.layout.prior_mean)
    settled = np.linalg.solve(matrix, force)
    prior = np.diag(nuisance_priors(problem))

    def linear(candidate: Candidate, guess: dict[str, float]) -> tuple[float, float]:
        """(s, b) of the guess; (0, 0) where it does not simulate."""
        layout, x = child_layout(problem, parent, candidate, guess)
        outputs = problem.outputs(layout, x, parent.start, parent.offset)
        cross, s, b = np.zeros(count), 0.0, 0.0
        for new, old, j, e, (nuisance, coupling) in zip(outputs, parent.outputs, parent.jacobian, parent.residuals,
                                                        back, strict=True):
            change = (new - old).ravel()
            if not np.all(np.isfinite(change)):
                return 0.0, 0.0
            products = j @ change
            own, tied = products[:count], products[count:]
            inner = j[count:] @ j[count:].T + prior
            cross += own - coupling.T @ tied
            s += float(change @ change - tied @ np.linalg.solve(inner, tied))
            b += float(change @ e.ravel() - tied @ nuisance)
        cross, s, b = cross / scale, s / scale, b / scale
        return s - float(cross @ np.linalg.solve(matrix, cross)), b - float(cross @ settled)

    def promise(task: tuple[Candidate, dict[str, float]]) -> Promise:
        candidate, guess = task
        s, b = linear(candidate, guess)
        found = _promised(candidate, guess, s, b)
        factor = min(BOLD / math.sqrt(s), 1.0) if s > 0.0 else 1.0
        smaller = _scaled(candidate, guess, factor)
        if smaller == guess:
            return found
        closer = _promised(candidate, guess, *linear(candidate, smaller))
        return max(found, replace(closer, size=factor * closer.size, information=s), key=lambda p: p.gain)

    tasks = [(c, g) for c in pool if c.effect is not None for g in c.guesses]
    found = list(problem.pool.map(promise, tasks))
    for candidate in pool:
        if candidate.effect is not None and candidate.effect.stage is Stage.CLOCK and problem.clock is not None:
            ratio, error = problem.clock
            found.append(Promise(candidate, {"ratio": ratio}, ((ratio - 1.0) / error) ** 2, 1.0, error**-2))
        if candidate.effect is None:
            found.append(_freed(problem, parent, candidate, normal.sum(axis=0) / scale, gradient.sum(axis=0) / scale))
    return sorted(found, key=lambda p: -p.gain)


def _promised(candidate: Candidate, guess: dict[str, float], s: float, b: float) -> Promise:
    if s <= 1e-9:
        return Promise(candidate, guess, 0.0, 1.0, max(s, 0.0))
    size = b / s
    gain = 0.0 if size <= 0.0 else s * (6.0 * size - 9.0) if size > 3.0 else b * b / s
    return Promise(candidate, guess, gain, size, s)


def _freed(problem: Problem, parent: Fit, candidate: Candidate, normal: np.ndarray, gradient: np.ndarray) -> Promise:
    """Predicted gain of setting one constant free: only its prior changes."""
    base, n = parent.layout, len(parent.layout.paths)
    layout = problem.layout(base.hypothesis + candidate.hypothesis, _sizes(base, parent.x))
    transform = np.eye(base.size)
    transform[:n, :n] = np.linalg.solve(base.root, layout.root)
    a, g = transform.T @ normal @ transform, transform.T @ gradient
    x = parent.x.copy()
    x[:n] = np.linalg.solve(layout.root, parent.logs)
    prior, mean = layout.prior_precision, base.prior_mean

    def cost(precision: np.ndarray, matrix: np.ndarray, slope: np.ndarray, at: np.ndarray) -> float:
        force = slope - precision * (at - mean)
        step = np.linalg.solve(matrix + np.diag(precision), force)
        return float(precision @ (at - mean) ** 2 - force @ step)

    before = cost(base.prior_precision, normal, gradient, parent.x)
    return Promise(candidate, {}, max(before - cost(prior, a, g, x), 0.0), 1.0, float(a.trace()))


def _sizes(layout: Layout, x: np.ndarray) -> dict[int, dict[str, float]]:
    sizes: dict[int, dict[str, float]] = {k: {} for k in range(len(layout.hypothesis.effects))}
    for coordinate, value in zip(layout.coordinates, x[len(layout.paths):], strict=False):
        sizes[coordinate.effect][coordinate.name] = coordinate.to_value(value)
    return sizes


def started(promise: Promise) -> tuple[dict[str, float], dict[str, float]]:
    """Where the prior of an effect's size is centred, near the guess, and where the fit begins, as screening says."""
    return tuple(_scaled(promise.candidate, promise.guess, min(max(promise.size, least), MOST)) for least in LEAST)


def _scaled(candidate: Candidate, guess: dict[str, float], factor: float) -> dict[str, float]:
    """A guess so many times its distance from neutral, within bounds."""
    if candidate.effect is None:
        return {}
    moved = {}
    infos = candidate.effect.parameters()
    for name, value in guess.items():
        info = infos[name]
        if info.neutral is None or not math.isfinite(info.neutral) or info.periodic:
            moved[name] = value
            continue
        scaled = info.neutral + factor * (value - info.neutral)
        moved[name] = min(max(scaled, info.low), info.high)
    return moved


def _starts_allowed(candidate: Candidate) -> int:
    """Guesses from which a quick fit begins: more where chi^2 has many valleys (angles, gaps)."""
    if candidate.effect is None:
        return 1
    return 3 if candidate.effect.stage is Stage.GAP else min(1 + len(candidate.guesses) // 5, 4)


def climb(search: Search, parent: Fit, pool: list[Candidate], share: tuple[float, float], least: float) -> Fit:
    """Fit the most promising further causes on top of a parent; returns the best child, or the parent.

    ``least`` is the predicted gain that is worth a fit.
    """
    problem, effort = search.problem, search.effort
    promises = screen(problem, parent, pool)
    if not search.promises:
        search.promises = promises
    chosen, per_key = [], {}
    for promise in promises:
        key = promise.candidate.key
        starts = per_key.setdefault(key, [])
        allowed = _starts_allowed(promise.candidate)
        if len(starts) < allowed and promise.gain > least and len(per_key) <= effort.fits:
            starts.append(promise)
            chosen.append(promise)

    def quick(promise: Promise) -> Fit | None:
        layout, x = child_layout(problem, parent, promise.candidate, *started(promise))
        try:
            return fit(problem, layout, x, parent.start, parent.offset, jacobian=child_jacobian(parent, layout),
                       parallel=False, renewals=0, iterations=10, tolerance=0.5)
        except LOST:
            return None

    fitted = []
    for index, found in enumerate(problem.pool.map(quick, chosen)):
        if found is not None:
            fitted.append(found)
        text = f"tried {chosen[index].candidate.hypothesis.label}"
        search.progress(text, share[0] + (share[1] - share[0]) * 0.6 * (index + 1) / len(chosen))
    begun = list(fitted)
    fitted.sort(key=lambda f: f.objective)
    for found in fitted:
        search.keep(found)
    best = parent

    def further(found: Fit) -> Fit:
        return go_on(problem, found, **search.care | {"tolerance": HALFWAY}, iterations=15)

    nearest = _nearest(fitted, parent, 0.8, effort.exact + 2)
    sets = {frozenset(f.layout.hypothesis.causes()) for f in nearest}
    for found in begun[: PROMISED if effort.thorough else 0]:
        key = frozenset(found.layout.hypothesis.causes())
        if key not in sets:
            nearest.append(search.fits[key])
            sets.add(key)
    halfway = list(problem.pool.map(further, nearest))
    for found in halfway:
        search.keep(found)
    exact = _nearest(sorted(halfway, key=lambda f: f.objective), parent, 0.2, effort.exact)
    if not effort.thorough:
        exact = [f for f in exact if f.objective < parent.objective]

    def to_the_end(found: Fit) -> Fit:
        return go_on(problem, found, **search.care, iterations=40)

    for index, found in enumerate(problem.pool.map(to_the_end, exact)):
        search.keep(found)
        search.progress(f"fitted {found.layout.hypothesis.label}",
                        share[0] + (share[1] - share[0]) * (0.6 + 0.4 * (index + 1) / len(exact)))
    if effort.thorough:
        _borrow(search, [frozenset(f.layout.hypothesis.causes()) for f in exact])
    temperature = search.temperature()
    for found in search.fits.values():
        keys = set(found.layout.hypothesis.causes())
        above = search.score(found, temperature) > search.score(best, temperature)
        if above and set(parent.layout.hypothesis.causes()) < keys:
            best = found
    return best


def _nearest(fitted: list[Fit], parent: Fit, share: float, most: int) -> list[Fit]:
    """The best fit of each set of causes, best first, as far as it buys what the best of all buys but for a share."""
    found: dict[frozenset[tuple[str, str]], Fit] = {}
    for one in fitted:
        least = fitted[0].objective
        if one.objective < least + max(CLOSE, share * (parent.objective - least)):
            found.setdefault(frozenset(one.layout.hypothesis.causes()), one)
    return list(found.values())[:most]


def _borrow(search: Search, keys: list[frozenset[tuple[str, str]]]) -> None:
    """Fit the close rivals of the best once more from the best's constants: no law loses by where its fit began."""
    problem = search.problem
    first, *others = sorted((search.fits[k] for k in keys if k in search.fits), key=lambda f: f.objective) or [None]

    def again(rival: Fit) -> Fit | None:
        x = rival.x.copy()
        n = len(rival.layout.paths)
        x[:n] = np.linalg.solve(rival.layout.root, first.logs)
        try:
            return fit(problem, rival.layout, x, first.start, first.offset, jacobian=rival.jacobian, iterations=10,
                       **search.care, parallel=False)
        except LOST:
            return None  # does not simulate from there; the fit that there is stands

    for found in problem.pool.map(again, [f for f in others if f.objective <= first.objective + CLOSE]):
        if found is not None:
            search.keep(found)


def look_back(search: Search, found: Fit) -> None:
    """Fit every set with one cause less, from where the whole set ended: each cause must hold against its absence."""
    problem, layout = search.problem, found.layout
    causes, sizes = layout.hypothesis.causes(), _sizes(layout, layout.prior_mean)

    def without(left_out: int) -> Fit | None:
        effects = [k for k in range(len(layout.hypothesis.effects)) if k != left_out]
        constants = tuple(c for k, c in enumerate(layout.hypothesis.constants, len(layout.hypothesis.effects))
                          if k != left_out)
        hypothesis = Hypothesis(tuple(layout.hypothesis.effects[k] for k in effects), constants)
        smaller = problem.layout(hypothesis, {i: sizes[k] for i, k in enumerate(effects)})
        x = _carried(found, smaller, [i for i, c in enumerate(layout.coordinates) if c.effect != left_out])
        try:
            return fit(problem, smaller, x, found.start, found.offset, iterations=15, **search.care,
                       parallel=False)
        except LOST:
            return None  # does not simulate from there; what there is of that set stands

    for smaller in problem.pool.map(without, range(len(causes))):
        if smaller is not None:
            search.keep(smaller)


def refined(problem: Problem, found: Fit) -> Fit:
    """A fit brought to its very end with finer simulations: values are stated from it."""
    searched, problem.accuracy = problem.accuracy, FINE
    try:
        return fit(problem, found.layout, found.x, found.start, found.offset, iterations=12, tolerance=0.02,
                   jacobian=found.jacobian_at(problem.scale))
    finally:
        problem.accuracy = searched


def recalibrate(search: Search, best: Fit) -> Fit:
    """Judge noise and misfit on the best hypothesis, and refit the leading ones with what it says."""
    problem = search.problem
    problem.unweigh()
    problem.calibrate(best.layout, best.x, best.start, best.offset)
    again = fit(problem, best.layout, best.x, best.start, best.offset, iterations=0,
                jacobian=best.jacobian_at(problem.scale))
    if again.chi2 > MISFIT * problem.samples.sum():
        problem.weigh(again.residuals)
    temperature = search.temperature()
    leading = sorted(search.fits.values(), key=lambda f: -search.score(f, temperature))
    parts = set(best.layout.hypothesis.causes())
    again = [f for f in leading if set(f.layout.hypothesis.causes()) <= parts]
    again += [f for f in leading if f not in again][: search.effort.exact - 1]
    care = search.care
    search.fits = {}

    def under_new_scale(found: Fit) -> Fit | None:
        with suppress(*LOST):        # does not simulate with the chatter of the best
            return fit(problem, found.layout, found.x, found.start, found.offset, iterations=10, **care,
                       jacobian=found.jacobian_at(problem.scale), parallel=False)
        return None

    for found in problem.pool.map(under_new_scale, again):
        if found is not None:
            search.keep(found)
    return search.best()


def explore(problem: Problem, effort: Effort, progress: Callable[[str, float], None]) -> Search:
    """The whole search, first with every rig driven by the logged commands.

    Command and outputs are then the two ends of the rig alone, and what rounding does inside the loop is in the log:
    where the right model is among the hypotheses this says most.  Where none reaches the noise, errors add up over a
    run that no controller corrects, and the search is done anew with closed loops.
    """
    search = _ladder(problem, effort, progress)
    if search.misfit and any(not commanded(run.metadata.controller) for run in problem.runs):
        problem.by_command, problem.accuracy = False, ROUGH
        less = replace(effort, fits=EFFORTS["quick"].fits, exact=EFFORTS["quick"].exact)
        search = _ladder(problem, less, progress)
        if not search.misfit:
            problem.accuracy = QUICK
            search = _ladder(problem, less, progress)
    return search


def _ladder(problem: Problem, effort: Effort, progress: Callable[[str, float], None]) -> Search:
    """One cause more per rung, from every set that becomes the best; stops where the next rung buys nothing."""
    search = Search(problem, effort, progress)
    progress("fitting the nominal rig's constants", 0.05)
    parent = base_fit(problem)
    search.keep(parent)
    before = search.temperature()
    pool = candidates(problem.rig)
    if not problem.by_command and search.misfit and max(problem.zero_group) > 0:
        # With an unknown zero per run these laws have a free angle per run, fit anything and predict nothing.
        pool = [c for c in pool if c.effect is None or c.effect.absolute is None]
    climbed: set[frozenset[tuple[str, str]]] = set()
    returns = RETURNS if effort.thorough and problem.by_command else 0
    while True:
        held = frozenset(parent.layout.hypothesis.causes())
        rung = len(held)
        if rung == effort.rungs or held in climbed:
            passed = _passed_over(search, climbed)
            if returns == 0 or passed is None or remainder(problem, parent).is_noise:
                break
            returns, parent = returns - 1, passed
            continue
        climbed.add(held)
        if rung > 0 and problem.clock is None:
            # Beside another cause a clock is but one more way to move the constants, which no data tell from theirs.
            pool = [c for c in pool if c.effect is None or c.effect.stage is not Stage.CLOCK]
        share = (0.1 + 0.8 * rung / effort.rungs, 0.1 + 0.8 * (rung + 1) / effort.rungs)
        others, least = [c for c in pool if c.key not in held], 4.0 if rung == 0 else 10.0
        child = climb(search, parent, others, share, least)
        if child is parent:
            parent = search.best()
            continue
        look_back(search, child)
        better = search.fits[held]
        if better.objective < parent.objective - CLOSE:     # the parent's fit had ended on a valley's side
            look_back(search, climb(search, better, others, share, least))
        parent = search.best()
        if rung == 0 and effort.thorough and problem.by_command and parent.strain > STRAINED:
            begun_anew(search, pool)
            parent = search.best()
        if not problem.by_command and (rung == 0 or search.misfit):
            parent = recalibrate(search, parent)
        if problem.by_command and search.hopeless(rung, before):
            break
        if not effort.thorough and remainder(problem, parent).is_noise:
            break
    if effort.thorough:
        swap(search, pool, climbed)
    return search


def swap(search: Search, pool: list[Candidate], climbed: set[frozenset[tuple[str, str]]]) -> None:
    """Hold causes of the best set against rivals in their place, where the ladder has not: it found them alone."""
    problem, best = search.problem, search.best()
    held = frozenset(best.layout.hypothesis.causes())
    singles = {c.key: c for c in pool if c.key not in held and frozenset({c.key}) in search.fits}
    alone = sorted(singles, key=lambda key: search.fits[frozenset({key})].objective)[:SWAPS]
    tasks = [(rest, singles[key]) for cause in held if (rest := held - {cause}) and rest in search.fits.keys() - climbed
             for key in alone if rest | {key} not in search.fits]

    def swapped(task: tuple[frozenset[tuple[str, str]], Candidate]) -> Fit | None:
        rest, candidate = task
        parent, single = search.fits[rest], search.fits[frozenset({candidate.key})]
        guess, start = (_sizes(single.layout, x).get(0, {}) for x in (single.layout.prior_mean, single.x))
        layout, x = child_layout(problem, parent, candidate, guess, start)
        x[: len(layout.paths)] = np.linalg.solve(layout.root, best.logs)
        with suppress(*LOST):    # went where nothing simulates
            begun = fit(problem, layout, x, best.start, best.offset, jacobian=child_jacobian(parent, layout),
                        iterations=10, tolerance=0.5, renewals=1, parallel=False)
            if begun.objective < best.objective + CLOSE:
                begun = go_on(problem, begun, **search.care, iterations=15)
            return begun
        return None

    for found in problem.pool.map(swapped, tasks):
        if found is not None:
            search.keep(found)


def _passed_over(search: Search, climbed: set[frozenset[tuple[str, str]]]) -> Fit | None:
    """The set that came nearest to being climbed from."""
    found = []
    for size in range(1, search.effort.rungs):
        least = min((search.fits[k].chi2 for k in climbed & search.fits.keys() if len(k) == size), default=0.0)
        found += [(f.chi2 / least, k) for k, f in search.fits.items() if len(k) == size and k not in climbed and least]
    ratio, keys = min(found, key=lambda row: row[0], default=(np.inf, frozenset()))
    return search.fits[keys] if ratio < NEAR else None
