"""Runs of a rigid axis by the station's own model, whole counts, and predictions of runs, for tests of the parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from station.estimation.dataset import dataset
from station.estimation.observer import observers
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.run import Run, RunMetadata
from tests.truth import CONTROLLERS, RIGID_AXIS

AXIS = Rig.model_validate(RIGID_AXIS)


def run_of(rig: Rig, amplitude: float, controller: str, name: str, seconds: float = 1.2) -> Run:
    """A step of a closed loop, or pulses to both sides of an open one."""
    rows = round(seconds * rig.sample_rate)
    t = np.arange(rows) / rig.sample_rate
    if controller == "open":
        reference = amplitude * np.sign(np.sin(2.0 * np.pi * (t - 0.1) / 0.5)) * (t >= 0.1)
    else:
        reference = np.where(t < 0.1, 0.0, amplitude)
    zero = np.zeros(rows)
    meta = RunMetadata(controller=CONTROLLERS[controller], command_row=0 if controller == "open" else -1, zero_id="one")
    made = simulate(rig, Run(name, t, reference, reference, zero, None, meta))
    return Run(name, t, reference, made.command, made.encoder, made.accel, meta)


def runs_of(rig: Rig) -> list[Run]:
    """Three runs."""
    return [run_of(rig, 90.0, "p2", "step"), run_of(rig, -60.0, "p1", "down"), run_of(rig, 60.0, "open", "pulses")]


def predictions(rig: Rig, runs: Sequence[Run]) -> Predictor:
    """Of runs, at the horizons of a diagnosis."""
    data = dataset(rig, runs)
    return Predictor(data, observers(data.rig, data.noise[0]), Pool())
