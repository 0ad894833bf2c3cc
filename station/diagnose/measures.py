"""Measures of a run and of how well a simulation meets it; the definitions of the diagnosis file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from station.estimation.dataset import content
from station.estimation.noise import QUANTISATION
from station.model.simulate import Simulation
from station.runs.quality import Scatter, between_repeats
from station.runs.run import Run
from station.runs.step_response import overshoot, rise_time, settling_time, step_row


def nrmse(measured: np.ndarray, simulated: np.ndarray) -> float:
    """||measured - simulated|| / ||measured - mean||; infinite where the measured channel never moves."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return float(np.linalg.norm(measured - simulated)) / spread if spread > 0.0 else math.inf


def floor(measured: np.ndarray, sigma: float, step: float = 1.0) -> float:
    """sqrt(n (sigma^2 + q^2/12)) / ||measured - mean||: what noise and rounding to steps q alone leave."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return math.sqrt(len(measured) * (sigma**2 + QUANTISATION * step**2)) / spread if spread > 0.0 else math.inf


def step_measures(run: Run, encoder: np.ndarray, part: slice = slice(None)) -> dict[str, float | None]:
    """What a step test is judged by, of ``part`` of its rows; empty for other tests."""
    reference, encoder = run.reference[part], encoder[part]
    if step_row(reference) is None or run.open_loop:
        return {}
    return {"overshoot_percent": overshoot(reference, encoder),
            "settling_time": settling_time(reference, encoder, run.t[part])}


def step_figures(run: Run, encoder: np.ndarray, part: slice = slice(None)) -> dict[str, float | None]:
    """The same with the rise from 10 to 90 %."""
    found = step_measures(run, encoder, part)
    return {**found, "rise_time": rise_time(run.reference[part], encoder[part], run.t[part])} if found else {}


def repeats(runs: Sequence[Run]) -> list[dict[str, float]]:
    """Per run and channel, where other runs repeat its test: the standard deviation between them as a share of the
    run's signal, in the measure of an nrmse; what a simulation that knows all but chance would leave.  Of a step that
    of its figures, too, in their units.

    Repeats have one controller, which is known, and one reference, or in an open loop one command, over the rows that
    both have, at least half of the longer; a log is no repeat of itself. The encoder counts from where a run began, the
    accelerometer from its mean.
    """
    found: list[dict[str, float]] = [{} for _ in runs]
    tests = {content(run): run for run in runs}
    for k, run in enumerate(runs):
        own = content(run)
        those = [run, *(other for log, other in tests.items() if log != own and _same_test(run, other))]
        rows = min(len(one.t) for one in those)
        for channel in ("encoder", "accel"):
            readings = [getattr(one, channel) for one in those]
            if len(those) < 2 or any(column is None for column in readings):
                continue
            cut = [column[:rows] - (column[0] if channel == "encoder" else column[:rows].mean()) for column in readings]
            size = float(np.std(getattr(run, channel)[:rows]))
            if size > 0.0:
                found[k][channel] = between_repeats(cut) / size
        steps = [step_figures(one, one.encoder) for one in those]
        for name in step_figures(run, run.encoder):
            between = Scatter.of([step.get(name) for step in steps]).sigma
            if between is not None:
                found[k][name] = between
    return found


def _same_test(one: Run, other: Run) -> bool:
    rows, longest = sorted((len(one.t), len(other.t)))
    if 2 * rows < longest or one.metadata.controller != other.metadata.controller:
        return False
    if one.open_loop:
        return bool(np.array_equal(one.command[:rows], other.command[:rows]))
    return not one.loop_unknown and bool(np.array_equal(one.reference[:rows], other.reference[:rows]))


def measures(run: Run, simulation: Simulation, rows: np.ndarray, ahead: float | None = None) -> dict[str, object]:
    """One run against one simulation, as ``compare --json`` writes it, of the ``rows`` (n) that count.

    What is predicted so many seconds ``ahead`` is no loop's answer to a step.
    """
    found: dict[str, object] = {"run": run.name,
                                "encoder": {"nrmse": nrmse(run.encoder[rows], simulation.encoder[rows])}}
    if run.accel is not None and simulation.accel is not None:
        found["accel"] = {"nrmse": nrmse(run.accel[rows], simulation.accel[rows])}
    found["measured"] = step_measures(run, run.encoder)
    found["simulated"] = step_measures(run, simulation.encoder) if ahead is None else {}
    return found
