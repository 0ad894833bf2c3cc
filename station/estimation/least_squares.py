"""Fitting one hypothesis: Levenberg-Marquardt with priors, per-run nuisances eliminated.

With errors e, Jacobian J and weights W = N/max(S, n)/T of the blocks (see ``likelihood``), a run adds the normal matrix
J'WJ and the gradient J'We; what each run has of its own is eliminated from both (Schur's complement).  Derivatives may
be handed over from a neighbouring hypothesis; after each step they are corrected by what the step did (Broyden 1965),
and computed afresh where that does not lead on.
"""

from __future__ import annotations

from functools import cached_property, partial

import numpy as np

from station.estimation.dataset import Dataset
from station.estimation.fitted import Fit, Information, Point
from station.estimation.identifiability import unseen_with_effects
from station.estimation.likelihood import Weighing, block_weights, cost, nuisance_precision
from station.estimation.parameters import Parameters
from station.estimation.prediction import Predictor

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

    def at(self, x: np.ndarray, own: np.ndarray) -> Point:
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
        return Point(x, own, predicted, residuals, squares, value if np.all(np.isfinite(squares)) else np.inf)

    def column(self, predictor: Predictor, here: Point, k: int) -> list[np.ndarray]:
        """Derivatives of the scaled predictions by one parameter or nuisance, per run; 0 where it has none (``small``).

        Sticking makes outputs kinked: what counts is the difference over a step, so steps are not tiny.
        """
        p = self.space.size
        for way in (1.0, -1.0):
            x, own, step = here.x.copy(), here.own.copy(), way * self.steps[k]
            if k < p:
                x[k] += step
            else:
                own[:, self.data.free[k - p]] += step
            moved = predictor.runs(self.space, x, own)
            changes = [(y - y0) * s for y, y0, s in zip(moved, here.predicted, self.scale, strict=True)]
            if all(map(self.small, range(len(changes)), changes)):
                return [change / step for change in changes]
        return [np.zeros_like(y) for y in here.predicted]

    def small(self, run: int, change: np.ndarray) -> bool:
        """Whether the step of a difference changes a run's scaled predictions (b, n) by less than all that was
        measured, and a count: one that runs away, or does not simulate, tells no derivative."""
        with np.errstate(over="ignore", invalid="ignore"):
            return bool(np.vdot(change, change) < self.most[run])

    @cached_property
    def most(self) -> list[float]:
        """Per run, the squares of all that was measured, and of a count in each reading, scaled."""
        return [float(np.sum((m * s) ** 2 + s**2)) for m, s in zip(self.measured, self.scale, strict=True)]

    def columns(self, here: Point, some: np.ndarray) -> list[list[np.ndarray]]:
        """Several of them: sent one by one they would take twice as long, a column is so quick."""
        around = self.predictor.around(self.space, here.x)
        return [self.column(around, here, k) for k in some.tolist()]

    def jacobian(self, here: Point, known: list[np.ndarray] | None = None) -> list[np.ndarray]:
        """Per run (p + c, b, n); those by constants and nuisances are taken from ``known``, if there is one.

        Along what no data show (a unit of torque) they are 0: differences cancel there to their own accuracy only, and
        of a law that bends sharply what is left would count for much where noise is small.  What moves some runs alone,
        an encoder's zero or a motor's place in a gap, is moved in all runs at once.
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
                change = (predicted[r] - here.predicted[r]) * self.scale[r]
                rows[r][k] = change / self.steps[k] if self.small(r, change) else 0.0
        unseen = unseen_with_effects(self.space, here.x)
        for row in rows if unseen.size else []:
            row[:p] -= np.tensordot(unseen, np.tensordot(unseen.T, row[:p], 1), 1)
        return rows

    def normal(self, here: Point, jac: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Normal matrix and force of the objective, and what gives the nuisances back: per run (c, p + 1)."""
        p, prior = self.space.size, self.space.precision
        matrix, force, back = np.diag(prior).copy(), -prior * (here.x - self.space.mean), []
        w = (block_weights(here.squares, self.counts, self.weighing.independent) / self.weighing.temperature
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

    def step(self, here: Point, matrix: np.ndarray, force: np.ndarray, back: list[np.ndarray]) -> Point | None:
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

    def information(self, here: Point, jac: list[np.ndarray]) -> Information:
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


def own_steps(data: Dataset) -> np.ndarray:
    """(4) finite-difference steps of what runs have of their own."""
    command = max(data.rms_command, IDLE * data.rig.amplifier.limit)
    return np.array([0.5 * data.rig.angle_per_count, OFFSET_STEP, STEP, STEP * command])


def point(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray) -> Point:
    """``x`` (p) and ``own`` (runs, 4), and how well they predict."""
    return _Descent(predictor, space, weighing, np.ones(len(predictor.data.runs))).at(x, own)


def fit(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray | None = None, *,
        iterations: int = 25, tolerance: float = 0.1, runs: np.ndarray | None = None,
        jacobian: list[np.ndarray] | None = None, renewals: int = 100, to_the_end: bool = False,
        first: float = NEAR) -> Fit:
    """Minimise the objective from ``x``; ``tolerance`` is the fall of it that ends the fit; ``to_the_end`` only if no
    more is expected, and with derivatives of where it ended.

    Expected is the squared Newton decrement (Boyd and Vandenberghe, Convex Optimization, 2004, section 9.5) of where
    the last step began: in a long valley a damped step wins next to nothing wherever it is.

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


def _broyden(jac: list[np.ndarray], old: Point, new: Point, descent: _Descent) -> None:
    """Correct Jacobians (per run) so that they give what a step did; nuisances in units of their priors."""
    for r, j in enumerate(jac):
        precision = np.concatenate([np.ones(descent.space.size), descent.nuisance[r]])
        step = np.concatenate([new.x - old.x, (new.own - old.own)[r, descent.data.free]])
        correct(j, step, precision, (new.predicted[r] - old.predicted[r]) * descent.scale[r])


def correct(jacobian: np.ndarray, step: np.ndarray, precision: np.ndarray, change: np.ndarray) -> None:
    """Make a Jacobian (k, b, n) give the ``change`` (b, n) that a ``step`` (k) made, and change it least otherwise, in
    units of which the squares are 1/``precision`` (k) (Broyden 1965)."""
    norm = float(np.sum(step**2 * precision))
    if norm > 1e-12:
        jacobian += (step * precision / norm)[:, None, None] * (change - np.tensordot(step, jacobian, 1))[None]


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
