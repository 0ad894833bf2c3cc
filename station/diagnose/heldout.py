"""What an extension buys on runs that no fit has seen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from station.diagnose.estimate import Fit, fit, nuisance_priors
from station.diagnose.measures import floor, nrmse
from station.diagnose.problem import Layout, Problem
from station.diagnose.result import ChannelGain, Gain
from station.model.simulate import Simulation, build


def settle(problem: Problem, layout: Layout, x: np.ndarray, start: np.ndarray, offset: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray]:
    """Starting angles and accelerometer offsets that suit a given rig best (two Gauss-Newton steps)."""
    prior = nuisance_priors(problem)
    angle = 0.5 * problem.rig.angle_per_count
    start, offset = start.copy(), offset.copy()
    for _ in range(2):
        here = problem.outputs(layout, x, start, offset, by_command=False)
        moved = [problem.outputs(layout, x, start + angle, offset, by_command=False)]
        if problem.has_accel:
            moved.append(problem.outputs(layout, x, start, offset + 0.1, by_command=False))
        for r, (y, m, s) in enumerate(zip(here, problem.measured, problem.scale, strict=True)):
            columns = np.stack([((o[r] - y) / d).ravel() for o, d in zip(moved, (angle, 0.1), strict=False)])
            away = np.array([start[r] - problem.start[r], offset[r] - problem.offset[r]])[: problem.channels]
            step = np.linalg.solve(columns @ columns.T + np.diag(prior), columns @ (m * s - y).ravel() - prior * away)
            start[r] += step[0]
            if problem.has_accel:
                offset[r] += step[1]
        start = problem.near_reading(start)
    return start, offset


def simulate_all(problem: Problem, layout: Layout, x: np.ndarray, start: np.ndarray, offset: np.ndarray,
                 rounding: bool = True) -> list[Simulation]:
    """Every run as the device would have read it (exact model, whole counts)."""
    model = build(problem.rig_of(layout, x))
    return [problem.simulate_run(model, layout, x, r, start[r], offset[r], rounding) for r in range(len(problem.runs))]


def leave_each_out(problem: Problem, found: Fit, **how: Any) -> list[Fit]:
    """For every run a fit that leaves that run out; ``how`` as in ``fit``, by default to the end.

    Begun from the fit of all runs, since the way from the prior ends in side valleys; what the left-out run alone had
    said is lost on the way to the end, for there the prior alone speaks.  Where in a gap the motor stood at its start
    is its own, as its starting angle is, and is kept.
    """
    def without(r: int) -> Fit:
        weights, layout = np.ones(len(problem.runs)), found.layout
        weights[r] = 0.0
        if layout.gap_places:
            mean, place = layout.prior_mean.copy(), layout.size - layout.gap_places + r
            mean[place] = found.x[place]
            layout = replace(layout, prior_mean=mean)
        return fit(problem, layout, found.x, found.start, found.offset, weights=weights,
                   jacobian=found.jacobian_at(problem.scale), parallel=False, **how)
    return list(problem.pool.map(without, range(len(problem.runs))))


def simulate_unseen(problem: Problem, left_out: list[Fit]) -> list[Simulation]:
    """Every run, simulated by the fit that left that run out."""
    def one(r: int) -> Simulation:
        left = left_out[r]
        start, offset = settle(problem, left.layout, left.x, left.start, left.offset)
        model = build(problem.rig_of(left.layout, left.x))
        return problem.simulate_run(model, left.layout, left.x, r, start[r], offset[r], True)
    return list(problem.pool.map(one, range(len(problem.runs))))


def mean_error(problem: Problem, simulations: list[Simulation]) -> float:
    """nrmse over all runs and channels, each alike: what a lab sees of a model."""
    errors = [nrmse(getattr(run, channel)[rows], getattr(simulation, channel)[rows])
              for run, rows, simulation in zip(problem.runs, problem.windows, simulations, strict=True)
              for channel in ("encoder", "accel")[: problem.channels]]
    return float(np.mean([e for e in errors if np.isfinite(e)]))


def gain(problem: Problem, names: list[str], before: list[Simulation], after: list[Simulation]) -> Gain:
    """The diagnosis file's gain: nrmse over all held-out runs and the share of the explainable error removed."""
    found, fractions = {}, []
    for c, channel in enumerate(("encoder", "accel")[: problem.channels]):
        error = {"before": 0.0, "after": 0.0}
        spread = explained = explainable = 0.0
        counted = False
        for run, rows, old, new in zip(problem.runs, problem.windows, before, after, strict=True):
            measured = getattr(run, channel)[rows]
            least = floor(measured, problem.noise[c])
            b, a = nrmse(measured, getattr(old, channel)[rows]), nrmse(measured, getattr(new, channel)[rows])
            size = float(np.sum((measured - measured.mean()) ** 2))
            if size == 0.0:
                continue
            spread += size
            error["before"] += b * b * size
            error["after"] += a * a * size
            if b > 1.2 * least:
                counted = True
                explained += b - a
                explainable += b - least
        if spread:
            found[channel] = ChannelGain(nrmse_before=float(np.sqrt(error["before"] / spread)),
                                         nrmse_after=float(np.sqrt(error["after"] / spread)))
        if counted:
            fractions.append(explained / explainable)
    return Gain(held_out=names, encoder=found.get("encoder"), accel=found.get("accel"),
                explained_fraction=float(np.mean(fractions)) if fractions else None)
