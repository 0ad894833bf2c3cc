"""Measures of a run and of how well a simulation meets it; the definitions of the diagnosis file."""

from __future__ import annotations

import math

import numpy as np

from station.estimation.noise import QUANTISATION
from station.model.simulate import Simulation
from station.runs.run import Run


def step_row(reference: np.ndarray) -> int | None:
    """Row of a run's one step, None where the reference is not one step."""
    rows = np.flatnonzero(np.diff(reference))
    return int(rows[0]) + 1 if rows.size == 1 else None


def overshoot(reference: np.ndarray, encoder: np.ndarray) -> float | None:
    """100 (max theta - r)/(r - r before the step), percent; for a step down with the smallest theta."""
    row = step_row(reference)
    if row is None:
        return None
    before, after = reference[row - 1], reference[row]
    peak = np.max(encoder) if after > before else np.min(encoder)
    return float(100.0 * (peak - after) / (after - before)) + 0.0     # never a negative zero


def settling_time(reference: np.ndarray, encoder: np.ndarray, t: np.ndarray) -> float | None:
    """Last time outside +-2 % of the step, s from the step; None where the run ends outside."""
    row = step_row(reference)
    if row is None:
        return None
    size = abs(reference[row] - reference[row - 1])
    outside = np.flatnonzero(np.abs(encoder[row:] - reference[row]) > 0.02 * size)
    if outside.size == 0:
        return 0.0
    last = row + int(outside[-1])
    return None if last == len(t) - 1 else float(t[last] - t[row])


def nrmse(measured: np.ndarray, simulated: np.ndarray) -> float:
    """||measured - simulated|| / ||measured - mean||; infinite where the measured channel never moves."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return float(np.linalg.norm(measured - simulated)) / spread if spread > 0.0 else math.inf


def floor(measured: np.ndarray, sigma: float) -> float:
    """sqrt(n (sigma^2 + q^2/12)) / ||measured - mean||: what noise and rounding alone leave."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return math.sqrt(len(measured) * (sigma**2 + QUANTISATION)) / spread if spread > 0.0 else math.inf


def step_measures(run: Run, encoder: np.ndarray) -> dict[str, float | None]:
    """What a step test is judged by; empty for other tests."""
    if step_row(run.reference) is None or run.open_loop:
        return {}
    return {"overshoot_percent": overshoot(run.reference, encoder),
            "settling_time": settling_time(run.reference, encoder, run.t)}


def measures(run: Run, simulation: Simulation) -> dict[str, object]:
    """One run against one simulation, as ``compare --json`` writes it; a filled run's lost rows do not count."""
    rows = run.logged
    found: dict[str, object] = {"run": run.name,
                                "encoder": {"nrmse": nrmse(run.encoder[rows], simulation.encoder[rows])}}
    if run.accel is not None and simulation.accel is not None:
        found["accel"] = {"nrmse": nrmse(run.accel[rows], simulation.accel[rows])}
    found["measured"] = step_measures(run, run.encoder)
    found["simulated"] = step_measures(run, simulation.encoder)
    return found
