"""A whole run as a rig would have answered it, with what the run has of its own."""

from __future__ import annotations

import math

import numpy as np

from station.diagnose.result import CHANNELS
from station.estimation.dataset import Dataset
from station.estimation.least_squares import own_steps
from station.estimation.likelihood import nuisance_precision
from station.estimation.observer import observers
from station.estimation.prediction import angle_that_reads, predict_run
from station.model.simulate import Model, Simulation, simulate_model

UNKNOWN_AHEAD = 0.5
"""Seconds ahead that a run is predicted for where its loop cannot be closed again."""


def not_closed(data: Dataset, run: int) -> str:
    """Why a run's loop cannot be closed again, as a clause; empty where it can, or none was closed."""
    this, record = data.runs[run], data.records[run]
    if this.open_loop:
        return ""
    if this.loop_unknown:
        return "the log does not say what closed its loop"
    if record.in_motion:
        return "the log begins in motion"
    moved = np.diff(this.reference, append=this.reference[-1])[this.blank].any()
    return "the reference moved in a gap of the log" if moved else ""


def seconds_ahead(data: Dataset, run: int) -> float | None:
    """How far ahead a run is predicted where its loop cannot be closed again.  None: it is simulated as a whole."""
    return UNKNOWN_AHEAD if not_closed(data, run) else None


def whole_run(data: Dataset, model: Model, run: int, own: np.ndarray, *, rounding: bool = True,
              zero: float = 0.0, place: float = 0.0) -> Simulation:
    """One run as its test would have gone on a rig; ``own`` (4) as ``Dataset.own`` has it.

    A closed loop is simulated from its reference, or predicted ``seconds_ahead`` of what was read before; an open one
    is simulated from its command, where that is known.
    """
    this, ahead, (start, offset, share, constant) = data.runs[run], seconds_ahead(data, run), (float(v) for v in own)
    if ahead is None and not (this.open_loop and data.records[run].finding.any()):
        return simulate_model(model, this, rounding=rounding, start_angle=angle_that_reads(model.rig, start, zero),
                              accel_offset=offset, zero=zero, gap_place=place, more=(share, constant))
    watched = observers(data.rig, data.noise[0], (ahead or math.inf,))
    found = predict_run(data, model, watched, run, own, zero=zero, place=place)[0][0]
    if rounding:
        found = np.floor(found + 0.5)
    return Simulation(this.t, this.reference, this.command, found[0], found[1] if data.has_accel else None)


def settled_run(data: Dataset, model: Model, run: int, own: np.ndarray, differ: tuple[float, float] = (0.0, 0.0),
                zero: float = 0.0, place: float = 0.0) -> Simulation:
    """The same with what suits the run best of what it has of its own (two Gauss-Newton steps), as the device would
    have read it; ``differ`` as ``Weighing`` has it."""
    moves = np.isin(data.free, np.flatnonzero([True, True, *(size > 0.0 for size in differ)]))
    free, prior = data.free[moves], nuisance_precision(data, differ)[run][moves]
    scale = np.sqrt(data.records[run].share) / data.sigma[:, None]
    steps, first, own = own_steps(data), data.own[run], own.copy()

    def outputs(own: np.ndarray) -> np.ndarray:
        made = whole_run(data, model, run, own, rounding=False, zero=zero, place=place)
        return np.stack([getattr(made, c) for c in CHANNELS[: data.channels]])

    for _ in range(2):
        here = outputs(own)
        if not np.all(np.isfinite(here)):
            break
        columns = np.stack([((outputs(own + steps * (np.arange(4) == k)) - here) * scale).ravel() / steps[k]
                            for k in free])
        error = ((data.records[run].measured - here) * scale).ravel()
        with np.errstate(over="ignore", invalid="ignore"):
            step = np.linalg.solve(columns @ columns.T + np.diag(prior), columns @ error - prior * (own - first)[free])
        if not np.all(np.isfinite(step)):
            break
        own[free] += step
        own[0] = np.clip(own[0], first[0] - data.rig.angle_per_count, first[0] + data.rig.angle_per_count)
    return whole_run(data, model, run, own, zero=zero, place=place)
