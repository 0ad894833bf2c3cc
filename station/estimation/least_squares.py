"""Fitting one hypothesis: Levenberg-Marquardt with priors, per-run nuisances eliminated.

With errors e, Jacobian J and weights W = N/max(S, n)/T of the blocks (see ``likelihood``), a run adds the normal matrix
J'WJ and the gradient J'We; what each run has of its own is eliminated from both (Schur's complement).  Derivatives may
be handed over from a neighbouring hypothesis; after each step they are corrected by what the step did (Broyden 1965),
and computed afresh where that does not lead on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.optimize import minimize

from station.estimation.dataset import SEVERAL, Dataset
from station.estimation.likelihood import (
    Weighing,
    cost,
    differ_precision,
    least_differ,
    nuisance_precision,
    rho,
    temperatures,
)
from station.estimation.parameters import Parameters
from station.estimation.prediction import Predictor
from station.rig import Rig

DIVERGED = (ArithmeticError, np.linalg.LinAlgError)
"""What a fit raises that went where nothing simulates."""
CANNOT_SIMULATE = ("these runs cannot be simulated with its constants, nor with others within their uncertainty; check "
                   "the rig file")
"""What is then said of a rig."""
STEP = 1e-5
"""Finite-difference step in whitened or logarithmic coordinates: the root of a simulation's own relative error, which
gives forward differences as many digits as they can have (Nocedal and Wright, Numerical Optimization, 2nd ed. 2006,
section 8.1).  Along directions that no output shows (a unit of length) the columns must cancel: what a wider step
leaves of their curvature there would count as information."""
PLACE_STEP = 0.02
"""Finite-difference step of the motor's place in a gap (artanh of its share)."""
OFFSET_STEP = 0.1
"""Finite-difference step of the accelerometer's offset, counts; of the starting angle half a count."""
IDLE = 0.005
"""Share of the amplifier's limit that commands are taken for, at least, where a step is one of them."""
LARGEST = np.array([0.3, 0.01])
"""Most by which runs differ: a share of the command (what the voltage of a supply that nothing regulates, a battery or
a wall adapter, may differ by from one day to another), and of the amplifier's limit (an offset of its input)."""
GRID = 7
"""Sizes of either kind, two units of the logarithm apart: the search for the most likely begins at their best pair."""
SIZES = 30
"""Sizes, evenly spaced in the logarithm, over which a density is averaged: half a unit apart."""
LONGEST = 2.0
"""Longest step in any coordinate, prior sigmas or logarithm."""
NEAR, FAR = 1e-5, 1e-3
"""First damping, a share of the largest information, of a fit that begins where another one ended and of one that
begins anywhere else (Madsen, Nielsen and Tingleff, Methods for Non-Linear Least Squares Problems, 2nd ed. 2004,
section 3.2)."""
LEAST_DAMPING = 1e-6
"""In units of the prior's precision, as all damping: what the data say nothing of must be damped, too, or it leads out
of narrow curved valleys (Transtrum, Machta and Sethna, Phys. Rev. E 83, 2011, section VI)."""
TRIES = 6
POOR = 0.5
"""Share of the predicted gain below which derivatives are computed afresh."""
GOOD, BAD = 0.75, 0.25
"""Shares of it above which the damping falls and below which it rises (Fletcher 1971)."""
MOST_GAINED = 20.0
"""What a step that is not simulated may be expected to gain of the data's part of the objective."""


@dataclass(frozen=True, eq=False)
class Information:
    """What the data say about the parameters near a fit, by stretch s of time and block b: any weights, any resample.

    Columns of M and v: the p parameters, then the nuisances of the stretch's run.
    """

    squares: np.ndarray
    """(s, b) sum of squared scaled errors."""
    counts: np.ndarray
    """(s, b) independent errors of the sensors."""
    normal: np.ndarray
    """(s, b, p + c, p + c) J'J."""
    gradient: np.ndarray
    """(s, b, p + c) J'e."""


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters, what runs have of their own, and how well they predict."""

    x: np.ndarray
    own: np.ndarray
    """(runs, 4) what each run has of its own (``Dataset.own``)."""
    predicted: list[np.ndarray]
    """Per run (b, n), counts."""
    residuals: list[np.ndarray]
    """Per run (b, n), scaled."""
    squares: np.ndarray
    """(runs, b) sums of squared scaled errors."""
    objective: float
    """-2 ln of likelihood (tempered) times priors."""


@dataclass(frozen=True, eq=False)
class Fit(_Point):
    """A fitted hypothesis."""

    space: Parameters
    away: np.ndarray
    """(runs, c) what runs have of their own, as far as it is free, from where it was before the fit."""
    counts: np.ndarray
    """(runs, b) independent errors of the sensors."""
    jacobian: list[np.ndarray] | None
    """Per run (p + c, b, n), scaled; None where it was let go."""
    information: Information
    weighing: Weighing
    nuisance: np.ndarray
    """(runs, c) prior precisions of what runs have of their own."""
    owner: np.ndarray
    """(s) the run of each stretch."""

    @property
    def key(self) -> frozenset[tuple[str, str]]:
        """The causes."""
        return self.space.hypothesis.key

    @property
    def misfit(self) -> float:
        """Mean squared error of the predictions, in units of the noise; 1 where nothing but noise is left."""
        return float(self.squares.sum() / self.counts.sum())

    @property
    def logs(self) -> np.ndarray:
        """Logarithms of constants over their nominal values."""
        return self.space.logs(self.x)

    @property
    def log_constants(self) -> float:
        """Log density of the constants' logarithms under their prior, up to a number that all hypotheses share."""
        w = self.x[self.space.parts["constants"]]
        return -0.5 * float(w @ w) - float(np.linalg.slogdet(self.space.root)[1])

    @property
    def light(self) -> Fit:
        """The same without derivatives, which take memory."""
        return replace(self, jacobian=None)

    def blocks(self, weighing: Weighing, drawn: np.ndarray | None = None) -> np.ndarray:
        """(..., runs, b) weights W of the blocks at this fit; ``drawn`` (..., s): how often each stretch counts in each
        resample."""
        squares, counts, independent = self.drawn(weighing, drawn)
        return independent / np.maximum(squares, counts) / weighing.temperature

    def drawn(self, weighing: Weighing, drawn: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squares, counts and independent errors (..., runs, b) of resamples."""
        info, many = self.information, 1.0 if drawn is None else drawn[..., None]
        counts = np.maximum(self._summed(many * info.counts), 1e-9)
        independent = weighing.independent * counts / np.maximum(self._summed(info.counts), 1e-9)
        return self._summed(many * info.squares), counts, independent

    def normal(self, weighing: Weighing, drawn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (p, p) and gradient (p) of the data, what runs have of their own eliminated."""
        normals, gradients = self.run_normals(weighing, drawn)
        return normals.sum(axis=0), gradients.sum(axis=0)

    def run_normals(self, weighing: Weighing, drawn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The same run by run: (runs, p, p) and (runs, p)."""
        return self._eliminated(*self._by_run(weighing, drawn), self.own_precision(weighing.differ))[:2]

    def own_precision(self, sizes: tuple[float, float] | np.ndarray) -> np.ndarray:
        """(..., runs, c) prior precisions of what runs have of their own where they differ by ``sizes`` (..., 2)."""
        differ = np.asarray(sizes, dtype=float)
        found = np.broadcast_to(self.nuisance, (*differ.shape[:-1], *self.nuisance.shape)).copy()
        if len(self.nuisance) >= SEVERAL:
            found[..., -2:] = differ_precision(self.space.rig, differ)[..., None, :]
        return found

    def _by_run(self, weighing: Weighing, drawn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """J'WJ (..., runs, p + c, p + c) and J'We (..., runs, p + c)."""
        info, w = self.information, self.blocks(weighing, drawn)[..., self.owner, :]
        w = w if drawn is None else w * drawn[..., None]
        return (np.stack([np.tensordot(w[..., own, :], info.normal[own], 2) for own in self._owned], axis=-3),
                np.stack([np.tensordot(w[..., own, :], info.gradient[own], 2) for own in self._owned], axis=-2))

    @cached_property
    def _owned(self) -> np.ndarray:
        """(runs, s) whether a stretch is a run's."""
        return self.owner == np.arange(len(self.squares))[:, None]

    def _summed(self, stretches: np.ndarray) -> np.ndarray:
        """Sums (..., runs, b) over the stretches (..., s, b) of each run."""
        return self._owned.astype(float) @ stretches

    def _eliminated(self, matrices: np.ndarray, slopes: np.ndarray, own: np.ndarray,
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal matrices and gradients of the parameters alone, run by run; (..., runs, c, c) the inverse precisions
        of what runs have of their own at given parameters, and (..., runs, c) their forces."""
        p = self.space.size
        inverse = np.linalg.inv(matrices[..., p:, p:] + own[..., None] * np.eye(own.shape[-1]))
        force = slopes[..., p:] - own * self.away
        across = matrices[..., :p, p:] @ inverse
        return (matrices[..., :p, :p] - across @ matrices[..., p:, :p],
                slopes[..., :p] - (across @ force[..., None])[..., 0], inverse, force)

    def _integrated(self, matrices: np.ndarray, slopes: np.ndarray, own: np.ndarray, most_gained: float = np.inf,
                    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """By Laplace's approximation, one Gauss-Newton step from the fit, for each of the prior precisions ``own``
        (..., runs, c): what is added to -2 ln L there, priors included; ln of the squared volume that the data leave of
        the priors', both (...); the posterior's precision (..., p, p); and of what runs have of their own the step
        (..., runs, c) and the inverse precisions (..., runs, c, c)."""
        p, prior, off = self.space.size, self.space.precision, self.x - self.space.mean
        normals, gradients, inverse, force = self._eliminated(matrices, slopes, own)
        matrix = normals.sum(axis=-3) + np.diag(prior)
        step = np.linalg.solve(matrix, (gradients.sum(axis=-2) - prior * off)[..., None])[..., 0]
        back = matrices[..., p:, :p] @ step[..., None, :, None]
        moved = (inverse @ (force[..., None] - back))[..., 0]
        shared = np.broadcast_to(step[..., None, :], (*moved.shape[:-1], p))
        whole = np.concatenate([shared, moved], axis=-1)
        gained = np.sum(whole * (2.0 * slopes - (matrices @ whole[..., None])[..., 0]), axis=(-2, -1))
        value = ((off + step) ** 2 @ prior - np.minimum(gained, most_gained)
                 + np.sum(own * (self.away + moved) ** 2, axis=(-2, -1)))
        volume = (np.sum(np.log(prior)) - np.linalg.slogdet(matrix)[1]
                  + np.sum(np.log(own), axis=(-2, -1)) + np.sum(np.linalg.slogdet(inverse)[1], axis=-1))
        return value, volume, (matrix, moved, inverse)

    def most_likely_differ(self, weighing: Weighing, may: tuple[bool, bool] = (True, True)) -> tuple[float, float]:
        """How much runs differ in what the motor does more than the rig says (``Weighing.differ``); in what they may
        not, they are held alike.

        Empirical Bayes (Gelman et al., section 13.6), about the fit: of highest marginal likelihood, parameters and
        what runs have of their own integrated out.  It has more than one mode: where all runs of a fit have moved the
        same way, a gain that differs stands in for one that is off.  So the best point of a grid is where it begins.
        Its slope follows from the runs' squares and what these leave uncertain (the identity behind expectation and
        maximisation: Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977); these rounds themselves take hundreds to
        arrive where runs are alike.
        """
        if len(self.squares) < SEVERAL:
            return 0.0, 0.0
        least = least_differ(self.space.rig)
        if not any(may):
            return float(least[0]), float(least[1])
        p, (matrices, slopes) = self.space.size, self._by_run(weighing)
        ends = np.log([least, np.where(may, largest_differ(self.space.rig), least)])

        def surprise(logs: np.ndarray) -> tuple[float, np.ndarray]:
            sizes = np.exp(logs)
            value, volume, (matrix, moved, inverse) = self._integrated(matrices, slopes, self.own_precision(sizes))
            coupled = inverse @ matrices[:, p:, :p]
            variance = np.diagonal(inverse + coupled @ np.linalg.solve(matrix, coupled.transpose(0, 2, 1)),
                                   axis1=1, axis2=2)
            found = np.sum(((self.away + moved) ** 2 + variance)[:, -2:], axis=0)
            return float(value - volume), 2.0 * (len(moved) - found / sizes**2)

        grid = np.stack(np.meshgrid(*np.linspace(ends[0], ends[1], GRID).T), axis=-1).reshape(-1, 2)
        value, volume, _ = self._integrated(matrices, slopes, self.own_precision(np.exp(grid)))
        begun = grid[np.argmin(value - volume)]
        sizes = np.exp(minimize(surprise, begun, jac=True, method="L-BFGS-B", bounds=ends.T).x)
        return float(sizes[0]), float(sizes[1])

    def log_narrowing(self, weighing: Weighing) -> np.ndarray:
        """(2) ln of the evidence, averaged over what runs may differ by in either, over that at ``weighing.differ``.

        Of a set's sizes only the order of magnitude is unknown beforehand: their logarithms are evenly distributed
        (Gelman et al., section 5.4), down to where runs are alike.  Sizes that the runs single out were one of many; a
        set that needs none has most of them.  The other size stays at its most likely.
        """
        if len(self.squares) < SEVERAL:
            return np.zeros(2)
        sizes = np.tile(weighing.differ, (2, SIZES, 1))
        ends = np.log([least_differ(self.space.rig), largest_differ(self.space.rig)])
        for k, logs in enumerate(np.linspace(ends[0], ends[1], SIZES).T):
            sizes[k, :, k] = np.exp(logs)
        value, volume, _ = self._integrated(*self._by_run(weighing),
                                            self.own_precision(np.vstack([weighing.differ, *sizes])))
        log_density = 0.5 * (volume - value)
        others = np.minimum(log_density[1:] - log_density[0], 0.0).reshape(2, SIZES)
        return np.log(np.trapezoid(np.exp(others), axis=1) / (SIZES - 1))

    @cached_property
    def covariance(self) -> np.ndarray:
        """Posterior covariance (p, p) under the fit's own weighing."""
        return np.linalg.pinv(self.normal(self.weighing)[0] + np.diag(self.space.precision), hermitian=True)

    def log_evidence(self, weighing: Weighing) -> float:
        """Laplace's approximation of ln p(data | hypothesis), up to a constant of the data.

        Under another weighing one Gauss-Newton step is taken from the fit.
        """
        return float(self.log_evidences(weighing, np.array(weighing.differ)))

    def log_evidences(self, weighing: Weighing, sizes: np.ndarray, drawn: np.ndarray | None = None) -> np.ndarray:
        """(...) the same where runs differ by ``sizes`` (..., 2) in place of ``weighing.differ`` and stretches count as
        often as ``drawn`` (..., s) says; the two are broadcast."""
        squares, counts, independent = self.drawn(weighing, drawn)
        value, volume, _ = self._integrated(*self._by_run(weighing, drawn), self.own_precision(sizes), MOST_GAINED)
        costs = np.sum(independent * rho(squares / counts), axis=(-2, -1))
        return 0.5 * (volume - value - costs / weighing.temperature)


class _Descent:
    """What a fit needs: predictions, parameters, weighing and the weights of the runs."""

    def __init__(self, predictor: Predictor, space: Parameters, weighing: Weighing, runs: np.ndarray) -> None:
        self.predictor, self.space, self.weighing, self.runs = predictor, space, weighing, runs
        data = self.data = predictor.data
        self.scale = [predictor.scale(r) for r in range(len(data.runs))]
        self.measured = [predictor.measured(r) for r in range(len(data.runs))]
        self.counts = predictor.counts
        self.nuisance = nuisance_precision(data, weighing.differ)
        self.steps = np.append(np.full(space.size, STEP), own_steps(data)[data.free])
        self.steps[space.parts["places"]] = PLACE_STEP
        self.of_runs = list(space.of_runs(data.zero_groups))

    def away(self, own: np.ndarray) -> np.ndarray:
        return (own - self.data.own)[:, self.data.free]

    def at(self, x: np.ndarray, own: np.ndarray) -> _Point:
        """Predict, and judge."""
        predicted = self.predictor.runs(self.space, x, own)
        with np.errstate(over="ignore", invalid="ignore"):
            residuals = [(m - y) * s for m, y, s in zip(self.measured, predicted, self.scale, strict=True)]
            squares = np.array([np.sum(e * e, axis=1) for e in residuals])
        used = self.runs > 0.0
        value = cost(squares[used], self.counts[used],
                     (self.runs[:, None] * self.weighing.independent)[used]) / self.weighing.temperature
        value += float(self.space.precision @ (x - self.space.mean) ** 2)
        value += float(np.sum(self.nuisance * self.away(own) ** 2))
        return _Point(x, own, predicted, residuals, squares, value if np.all(np.isfinite(squares)) else np.inf)

    def column(self, here: _Point, k: int) -> list[np.ndarray]:
        """Derivatives of the scaled predictions by one parameter or nuisance, per run; 0 where none is simulated.

        Sticking makes outputs kinked: what counts is the difference over a step, so steps are not tiny.
        """
        p = self.space.size
        for way in (1.0, -1.0):
            x, own, step = here.x.copy(), here.own.copy(), way * self.steps[k]
            if k < p:
                x[k] += step
            else:
                own[:, self.data.free[k - p]] += step
            moved = self.predictor.runs(self.space, x, own)
            if all(np.all(np.isfinite(y)) for y in moved):
                return [(y - y0) * s / step for y, y0, s in zip(moved, here.predicted, self.scale, strict=True)]
        return [np.zeros_like(y) for y in here.predicted]

    def columns(self, here: _Point, some: np.ndarray) -> list[list[np.ndarray]]:
        """Several of them: sent one by one they would take twice as long, a column is so quick."""
        return [self.column(here, k) for k in some.tolist()]

    def jacobian(self, here: _Point, known: list[np.ndarray] | None = None) -> list[np.ndarray]:
        """Per run (p + c, b, n); those by constants and nuisances are taken from ``known``, if there is one.

        What moves some runs alone, an encoder's zero or a motor's place in a gap, is moved in all runs at once.
        """
        p, alone = self.space.size, {k for kind in self.of_runs for _, k in kind}
        size = p + len(self.data.free)
        rows = [np.zeros((size, *y.shape)) for y in here.predicted] if known is None else [j.copy() for j in known]
        shared = [k for k in (range(size) if known is None else range(len(self.space.paths), p))
                  if k not in alone]
        pool = self.predictor.pool
        parts = np.array_split(shared, pool.size)
        for some, columns in zip(parts, pool.map(partial(self.columns, here), parts), strict=True):
            for k, column in zip(some, columns, strict=True):
                for row, changes in zip(rows, column, strict=True):
                    row[k] = changes
        for kind in filter(None, self.of_runs):
            x, moved = here.x.copy(), sorted({k for _, k in kind})
            x[moved] += self.steps[moved]
            predicted = self.predictor.runs(self.space, x, here.own)
            for row in rows:
                row[moved] = 0.0
            for r, k in kind:
                change = (predicted[r] - here.predicted[r]) * self.scale[r] / self.steps[k]
                rows[r][k] = change if np.all(np.isfinite(change)) else 0.0
        return rows

    def normal(self, here: _Point, jac: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Normal matrix and force of the objective, and what gives the nuisances back: per run (c, p + 1)."""
        p, prior = self.space.size, self.space.precision
        matrix, force, back = np.diag(prior).copy(), -prior * (here.x - self.space.mean), []
        w = (self.weighing.independent / np.maximum(here.squares, self.counts) / self.weighing.temperature
             * self.runs[:, None])
        away = self.away(here.own)
        for r, (j, e) in enumerate(zip(jac, here.residuals, strict=True)):
            root = np.sqrt(np.maximum(w[r], 1e-12))[:, None]
            flat = (j * root).reshape(len(j), -1)
            m, v = flat @ flat.T, flat @ (e * root).ravel()
            inner = m[p:, p:] + np.diag(self.nuisance[r])
            solved = np.linalg.solve(inner, np.column_stack([m[p:, :p], v[p:] - self.nuisance[r] * away[r]]))
            matrix += m[:p, :p] - m[:p, p:] @ solved[:, :p]
            force += v[:p] - m[:p, p:] @ solved[:, p]
            back.append(solved)
        return matrix, force, back

    def step(self, here: _Point, matrix: np.ndarray, force: np.ndarray, back: list[np.ndarray]) -> _Point | None:
        """The point one damped Gauss-Newton step away."""
        step = np.linalg.solve(matrix, force)
        if not np.all(np.isfinite(step)):
            return None
        step *= min(1.0, LONGEST / max(np.max(np.abs(step)), 1e-300))
        nuisance = np.array([b[:, -1] - b[:, :-1] @ step for b in back])
        own, count = here.own.copy(), self.data.rig.angle_per_count
        own[:, self.data.free] += nuisance
        own[:, 0] = np.clip(own[:, 0], self.data.start - count, self.data.start + count)
        return self.at(here.x + step, own)

    def information(self, here: _Point, jac: list[np.ndarray]) -> Information:
        """Sums over the stretches."""
        data, stretches, (size, blocks, _) = self.data, len(self.data.segment_run), jac[0].shape
        squares, counts = np.zeros((stretches, blocks)), np.zeros((stretches, blocks))
        normal, gradient = np.zeros((stretches, blocks, size, size)), np.zeros((stretches, blocks, size))
        for r, (j, e) in enumerate(zip(jac, here.residuals, strict=True)):
            share = self.predictor.share(r)
            segment = data.records[r].segment
            for s in np.unique(segment):
                begin, end = np.searchsorted(segment, (s, s + 1))
                part = np.ascontiguousarray(j[:, :, begin:end].transpose(1, 0, 2))
                squares[s], counts[s] = np.sum(e[:, begin:end] ** 2, axis=1), share[:, begin:end].sum(axis=1)
                normal[s] = part @ part.transpose(0, 2, 1)
                gradient[s] = np.einsum("bkn,bn->bk", part, e[:, begin:end])
        return Information(squares, counts, normal, gradient)


def largest_differ(rig: Rig) -> np.ndarray:
    """(2) the most by which runs differ: a share of the command, and a constant (counts of command)."""
    return LARGEST * np.array([1.0, rig.amplifier.limit])


def own_steps(data: Dataset) -> np.ndarray:
    """(4) finite-difference steps of what runs have of their own."""
    command = max(data.rms_command, IDLE * data.rig.amplifier.limit)
    return np.array([0.5 * data.rig.angle_per_count, OFFSET_STEP, STEP, STEP * command])


def objective(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray) -> float:
    """-2 ln of the posterior, up to a constant, at ``x`` (p) and ``own`` (runs, 4); infinite where lost."""
    return _Descent(predictor, space, weighing, np.ones(len(predictor.data.runs))).at(x, own).objective


def fit(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray | None = None, *,
        iterations: int = 25, tolerance: float = 0.1, runs: np.ndarray | None = None,
        jacobian: list[np.ndarray] | None = None, renewals: int = 100, to_the_end: bool = False,
        first: float = NEAR) -> Fit:
    """Minimise the objective from ``x``; ``tolerance`` is the fall of it that ends the fit; ``to_the_end`` only if no
    more is expected, and with derivatives of where it ended.

    Expected is the squared Newton decrement (Boyd and Vandenberghe, Convex Optimization, 2004, section 9.5): in a long
    valley a damped step wins next to nothing wherever it is.

    ``runs`` (runs): weights, of which 0 leaves a run out; then the prior alone moves what it has of its own.
    ``jacobian`` (per run (p + c, b, n)) starts the quick way; where it leads no further the derivatives are computed
    afresh, at most ``renewals`` times.  ``first``: NEAR or FAR.  ArithmeticError: the start does not simulate.
    """
    data, predictor = predictor.data, predictor.near(space, x)
    descent = _Descent(predictor, space, weighing, np.ones(len(data.runs)) if runs is None else runs)
    here = descent.at(x, data.own if own is None else own)
    if not np.isfinite(here.objective):
        raise ArithmeticError("the fit's start does not simulate")
    jac, fresh = descent.jacobian(here, jacobian), jacobian is None
    damping = 0.0
    for _ in range(iterations):
        matrix, force, back = descent.normal(here, jac)
        damping = damping or first * float(np.max(np.diag(matrix) / space.precision))
        found = None
        for _ in range(TRIES if fresh else 3):
            trial = descent.step(here, matrix + np.diag(damping * space.precision), force, back)
            if trial is not None and trial.objective < here.objective:
                found = trial
                break
            damping *= 10.0
        gain, ratio, at_hand = 0.0, 0.0, fresh
        if found is not None:
            step = found.x - here.x
            gain = here.objective - found.objective
            ratio = gain / max(float(2.0 * force @ step - step @ matrix @ step), 1e-300)
            damping *= 0.1 if ratio > GOOD else 1.0 if ratio > BAD else 3.0
            damping = max(damping, LEAST_DAMPING)
            _broyden(jac, here, found, descent)
            here, fresh = found, False
        expected = float(force @ np.linalg.solve(matrix, force)) if to_the_end else 0.0
        if ratio > POOR and max(gain, expected) >= tolerance or gain >= tolerance and renewals <= 0:
            continue
        if renewals <= 0 or ratio > POOR or at_hand and gain < tolerance:
            break
        jac, fresh, renewals = descent.jacobian(here), True, renewals - 1
    if to_the_end and not fresh:
        jac = descent.jacobian(here)
    return Fit(**vars(here), space=space, away=descent.away(here.own), counts=descent.counts, jacobian=jac,
               information=descent.information(here, jac), weighing=weighing, nuisance=descent.nuisance,
               owner=data.segment_run)


def _broyden(jac: list[np.ndarray], old: _Point, new: _Point, descent: _Descent) -> None:
    """Correct Jacobians (per run) so that they give what a step did; nuisances in units of their priors."""
    for r, j in enumerate(jac):
        units = np.concatenate([np.ones(descent.space.size), np.sqrt(descent.nuisance[r])])
        step = np.concatenate([new.x - old.x, (new.own - old.own)[r, descent.data.free]])
        norm = float(np.sum((step * units) ** 2))
        if norm > 1e-12:
            change = (new.predicted[r] - old.predicted[r]) * descent.scale[r]
            j += (step * units**2 / norm)[:, None, None] * (change - np.tensordot(step, j, 1))[None]


def inherited(parent: Fit, space: Parameters) -> list[np.ndarray]:
    """A parent's derivatives by the constants and nuisances, in another hypothesis' coordinates; the others are 0."""
    assert parent.jacobian is not None
    old, n = parent.space, len(space.paths)
    transform = np.linalg.solve(old.root, space.root)
    found = []
    for j in parent.jacobian:
        out = np.zeros((space.size + len(j) - old.size, *j.shape[1:]))
        out[:n] = np.tensordot(transform.T, j[:n], 1)
        out[space.size:] = j[old.size:]
        found.append(out)
    return found


def weighing_of(predictor: Predictor, found: Fit, counted: np.ndarray | None = None) -> Weighing:
    """What the blocks count for where a fit's errors are taken for what a model of this rig leaves; ``counted`` (b):
    those that do, all by default."""
    independent = predictor.independent(found.squares, found.residuals)
    cold = Weighing(independent if counted is None else independent * counted, 1.0, found.weighing.differ)
    kinds, whole = temperatures(*_projected(found, cold), found.space.precision)
    warm = Weighing(cold.independent / kinds, whole, cold.differ)
    return replace(warm, differ=found.most_likely_differ(warm))


def _projected(found: Fit, weighing: Weighing) -> tuple[np.ndarray, np.ndarray]:
    """(b, p, p) the likelihood's curvature, of every kind of block, and (s, b, p) its slopes in every stretch, what
    runs have of their own eliminated."""
    info, p = found.information, found.space.size
    w = found.blocks(weighing)[found.owner]
    curvatures, slopes = np.zeros((w.shape[1], p, p)), np.zeros((*w.shape, p))
    owns = found.own_precision(weighing.differ)
    for r in range(len(found.squares)):
        own = found.owner == r
        matrices, forces = np.einsum("sb,sbij->bij", w[own], info.normal[own]), w[own, :, None] * info.gradient[own]
        whole = matrices.sum(axis=0)
        take = np.linalg.solve(whole[p:, p:] + np.diag(owns[r]), whole[p:, :p])
        kept = np.vstack([np.eye(p), -take])
        curvatures += kept.T @ matrices @ kept
        slopes[own] = forces @ kept
    return curvatures, slopes
