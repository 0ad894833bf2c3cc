"""Fitting one hypothesis: Levenberg-Marquardt with priors, per-run nuisances eliminated, evidence by Laplace.

With residuals e, Jacobian J and nuisance columns N of one run (prior precision P), eliminating the nuisances gives
the run's normal matrix A = J'J - J'N (N'N + P)^-1 N'J and gradient g = J'e - J'N (N'N + P)^-1 N'e.  Runs add.

While a model does not reach the noise, chi^2/n is taken as the noise's scale (never below 1): priors keep their say
against a misfit that is not noise, and far from the optimum steps stay where the linearisation holds.

Derivatives by the constants may be handed over from a neighbouring hypothesis.  After each step they are corrected by
what the step did (Broyden 1965), and computed afresh only where that does not lead on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.diagnose.problem import Layout, Problem

STEP = 2e-3
"""Finite-difference step in whitened or logarithmic coordinates."""
HUGE = 1e30
LONGEST = 2.0
"""Longest step in any coordinate, prior sigmas or logarithm."""
PLACE_STEP = 0.02
"""Finite-difference step of the motor's place in a gap (artanh of its share)."""
OFFSET_STEP = 0.1
"""Finite-difference step of the accelerometer's offset, counts."""
POOR = 0.2
"""Share of the predicted gain below which derivatives are computed afresh."""
SETTLED = 0.3
"""Squared distance, posterior sigmas, over which derivatives are taken to stay."""


@dataclass(eq=False)
class Fit:
    """A fitted hypothesis."""

    layout: Layout
    x: np.ndarray
    start: np.ndarray
    offset: np.ndarray
    objective: float
    """Minus twice the log posterior, the noise's scale profiled out."""
    costs: np.ndarray
    """(runs, channels) sums of squared scaled residuals."""
    penalty: np.ndarray
    """(runs) what the nuisances' priors add."""
    normal: np.ndarray
    """(runs, p, p), nuisances eliminated."""
    gradient: np.ndarray
    """(runs, p)."""
    residuals: list[np.ndarray]
    """Per run (channels, n), scaled."""
    outputs: list[np.ndarray]
    """Per run (channels, n), scaled."""
    jacobian: list[np.ndarray]
    """Per run (p + nuisances, channels n)."""
    scale: list[np.ndarray]
    """Per run (channels, n), what residuals, outputs and derivatives are scaled with."""

    @property
    def chi2(self) -> float:
        """Of the data, over all runs, nuisances' priors included."""
        return float(self.costs.sum() + self.penalty.sum())

    @property
    def logs(self) -> np.ndarray:
        """Logarithms of constants over their nominal values."""
        return self.layout.root @ self.x[: len(self.layout.paths)]

    def jacobian_at(self, scale: list[np.ndarray]) -> list[np.ndarray]:
        """The derivatives under other scales."""
        return [j * (new / np.where(old > 0.0, old, 1.0)).ravel()
                for j, new, old in zip(self.jacobian, scale, self.scale, strict=True)]

    def precision(self, temperature: float = 1.0) -> np.ndarray:
        """Posterior precision (p, p)."""
        return self.normal.sum(axis=0) / temperature + np.diag(self.layout.prior_precision)

    def covariance(self, temperature: float = 1.0) -> np.ndarray:
        """Posterior covariance (p, p)."""
        return np.linalg.pinv(self.precision(temperature), hermitian=True)

    def log_evidence(self, temperature: float = 1.0) -> float:
        """Laplace's approximation of log p(data | hypothesis), up to a constant of the data."""
        prior = self.layout.prior_precision
        delta = self.x - self.layout.prior_mean
        _, logdet = np.linalg.slogdet(self.precision(temperature))
        return float(-0.5 * self.chi2 / temperature - 0.5 * np.sum(prior * delta**2)
                     + 0.5 * np.sum(np.log(prior)) - 0.5 * logdet)


def nuisance_priors(problem: Problem) -> np.ndarray:
    """Prior precisions of a run's starting angle (rad) and accelerometer offset (counts)."""
    return np.array([(0.35 * problem.rig.angle_per_count) ** -2, 0.5**-2])[: problem.channels]


def eliminate(problem: Problem, fit_start: np.ndarray, fit_offset: np.ndarray, residuals: list[np.ndarray],
              jacobian: list[np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray, list[tuple]]:
    """Normal matrices and gradients per run without the nuisances, and what gives the nuisances back."""
    prior = nuisance_priors(problem)
    normal, gradient, back = [], [], []
    for r, e in enumerate(residuals):
        params, nuisances = jacobian[r][:count], jacobian[r][count:]
        away = np.array([fit_start[r] - problem.start[r], fit_offset[r] - problem.offset[r]])[: problem.channels]
        inner = nuisances @ nuisances.T + np.diag(prior)
        cross = nuisances @ params.T
        solved = np.linalg.solve(inner, np.column_stack([cross, nuisances @ e.ravel() - prior * away]))
        normal.append(params @ params.T - cross.T @ solved[:, :-1])
        gradient.append(params @ e.ravel() - cross.T @ solved[:, -1])
        back.append((solved[:, -1], solved[:, :-1]))
    return np.array(normal), np.array(gradient), back


def fit(problem: Problem, layout: Layout, x: np.ndarray, start: np.ndarray | None = None,
        offset: np.ndarray | None = None, *, iterations: int = 25, tolerance: float = 0.1,
        weights: np.ndarray | None = None, jacobian: list[np.ndarray] | None = None, parallel: bool = True,
        exact_end: bool = True, poor: float = POOR) -> Fit:
    """Minimise chi^2 plus priors from ``x``; ``tolerance`` is the fall of the objective that ends it.

    ``weights`` (runs) of 0 leave a run out of the fit; its nuisances follow all the same.  ``jacobian`` (per run
    (p + nuisances, channels n)) starts the quick way; ``exact_end`` computes the derivatives afresh before it ends.
    A step that gains less than the share ``poor`` of what was predicted asks for fresh derivatives (infinite: always).
    ``parallel`` spreads the work over the problem's threads; not from one of them.
    """
    start = problem.start.copy() if start is None else start.copy()
    offset = problem.offset.copy() if offset is None else offset.copy()
    weights = np.ones(len(problem.runs)) if weights is None else weights
    scaled = [m * s for m, s in zip(problem.measured, problem.scale, strict=True)]
    nuisance_prior, prior = nuisance_priors(problem), layout.prior_precision
    samples, count, constants = float(weights @ problem.samples), layout.size, len(layout.paths)
    run_map = problem.pool.map if parallel else map
    angle = 0.5 * problem.rig.angle_per_count

    def look(x: np.ndarray, start: np.ndarray, offset: np.ndarray):
        outputs = problem.outputs(layout, x, start, offset, parallel=parallel)
        residuals = [m - y for m, y in zip(scaled, outputs, strict=True)]
        with np.errstate(over="ignore", invalid="ignore"):
            costs = np.array([np.sum(e * e, axis=1) for e in residuals])
        away = np.stack([start - problem.start, offset - problem.offset])[: problem.channels]
        penalty = nuisance_prior @ away**2
        data = float(weights @ (costs.sum(axis=1) + penalty))
        if not data < HUGE:
            return np.inf, np.inf, outputs, residuals, costs, penalty
        total = data if data <= samples else samples * (1.0 + np.log(data / samples))
        return total + float(prior @ (x - layout.prior_mean) ** 2), data, outputs, residuals, costs, penalty

    def columns(which: list[int], spread: np.ndarray) -> list[np.ndarray]:
        """Changes of the outputs by steps along columns ``which`` of ``spread``, per run stacked.

        count: the starting angle; count + 1: the offset; -1: the motor's places in the gaps, one row per run.
        Sticking makes outputs kinked; a difference over the width that the data leave open is the one that counts.
        """
        def moved(k: int) -> list[np.ndarray]:
            if k < 0:
                other = x.copy()
                other[shared:] += PLACE_STEP
                return problem.outputs(layout, other, start, offset)
            if k < count:
                return problem.outputs(layout, x + spread[:, k], start, offset)
            if k == count:
                return problem.outputs(layout, x, start + angle, offset)
            return problem.outputs(layout, x, start, offset + OFFSET_STEP)
        found = list(run_map(moved, which))
        rows: list[np.ndarray] = []
        for r, before in enumerate(outputs):
            changes = []
            for k, y in zip(which, found, strict=True):
                change = (y[r] - before).ravel()
                changes += [change] if k >= 0 else [change * (place == r) for place in range(layout.gap_places)]
            rows.append(np.stack(changes))
        return rows

    def afresh(spread: np.ndarray) -> list[np.ndarray]:
        """The whole Jacobian, from steps along the columns of ``spread``."""
        found = columns(everything, spread)
        for changes in found:
            changes[:shared] = np.linalg.solve(spread[:shared, :shared].T, changes[:shared])
            changes[shared:count] /= PLACE_STEP
            changes[count:] /= np.array([angle, OFFSET_STEP])[: problem.channels, None]
        return found

    def axes() -> np.ndarray:
        """The posterior's own axes and widths."""
        matrix = np.tensordot(weights, normal, 1) / max(data / samples, 1.0) + np.diag(prior)
        values, vectors = np.linalg.eigh(matrix[:shared, :shared])
        found = vectors / np.sqrt(np.maximum(values, 1e-12))
        spread = np.zeros((count, count))
        spread[:shared, :shared] = found * np.minimum(
            1.0, 0.5 / np.maximum(np.max(np.abs(found), axis=0), 1e-300))
        return spread

    shared = count - layout.gap_places
    places = [-1] if layout.gap_places else []
    everything = [*range(shared), *places, *range(count, count + problem.channels)]
    effects = [*range(constants, shared), *places]
    objective, data, outputs, residuals, costs, penalty = look(x, start, offset)
    if objective == np.inf:
        raise ArithmeticError("the fit's start does not simulate")
    plain_steps = STEP * np.eye(count)
    jac = afresh(plain_steps) if jacobian is None else [j.copy() for j in jacobian]
    drift = 0.0 if jacobian is None else np.inf
    along_axes, damping = False, 1e-3
    normal, gradient, back = eliminate(problem, start, offset, residuals, jac, count)
    for _ in range(iterations):
        if drift > 0.0 and effects:
            for j, new in zip(jac, columns(effects, plain_steps), strict=True):
                j[constants:shared] = new[: shared - constants] / STEP
                j[shared:count] = new[shared - constants:] / PLACE_STEP
            normal, gradient, back = eliminate(problem, start, offset, residuals, jac, count)
        scale = max(data / samples, 1.0)
        matrix = np.tensordot(weights, normal, 1) / scale + np.diag(prior)
        force = weights @ gradient / scale - prior * (x - layout.prior_mean)
        gain = ratio = 0.0
        for _ in range(5):
            step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), force)
            if not np.all(np.isfinite(step)):
                damping *= 10.0
                continue
            step *= min(1.0, LONGEST / max(np.max(np.abs(step)), 1e-300))
            nuisance = np.array([b[0] - b[1] @ step for b in back])
            new_start = problem.near_reading(start + nuisance[:, 0])
            nuisance[:, 0] = new_start - start
            new_offset = offset + nuisance[:, 1] if problem.has_accel else offset
            trial = look(x + step, new_start, new_offset)
            if trial[0] < objective:
                gain = objective - trial[0]
                ratio = gain / max(float(2.0 * force @ step - step @ matrix @ step), 1e-300)
                break
            damping *= 10.0
        if gain > 0.0:
            move = [np.concatenate([step, nuisance[r]]) for r in range(len(outputs))]
            old, x, start, offset = outputs, x + step, new_start, new_offset
            objective, data, outputs, residuals, costs, penalty = trial
            damping = max(damping / 10.0, 1e-9)
            drift += float(step @ matrix @ step)
            _broyden(jac, move, [new - y for new, y in zip(outputs, old, strict=True)], count, nuisance_prior)
            normal, gradient, back = eliminate(problem, start, offset, residuals, jac, count)
        if gain >= tolerance and (ratio > poor or not exact_end):
            continue
        if not exact_end or (gain < tolerance and drift < SETTLED and along_axes):
            break
        jac, along_axes, drift, damping = afresh(axes()), True, 0.0, min(damping, 1e-3)
        normal, gradient, back = eliminate(problem, start, offset, residuals, jac, count)
    return Fit(layout, x, start, offset, objective, costs, penalty, normal, gradient, residuals, outputs, jac,
               [s.copy() for s in problem.scale])


def _broyden(jac: list[np.ndarray], move: list[np.ndarray], change: list[np.ndarray], count: int,
             nuisance_prior: np.ndarray) -> None:
    """Correct Jacobians (per run) so that they give what a step did; nuisances in units of their priors."""
    units = np.concatenate([np.ones(count), np.sqrt(nuisance_prior)])
    for j, step, new in zip(jac, move, change, strict=True):
        norm = float(np.sum((step * units) ** 2))
        if norm > 1e-12:
            j += np.outer(step * units**2 / norm, new.ravel() - step @ j)
