"""A run's logged command through a rig, whatever closed the loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.estimation.noise import rest_start
from station.model import stepper
from station.model.along import true_encoder
from station.model.simulate import Model, Simulation, build, controller_arrays, initial_state, simulate_model
from station.pictures.plant import Motion
from station.rig import Rig
from station.runs.run import Run, RunMetadata


def resting(rig: Rig, run: Run) -> tuple[float, float]:
    """A run's starting angle (rad) and its accelerometer's offset (counts), means over the rows at rest."""
    rest = rest_start(run)
    start = float(np.mean(true_encoder(rig, run.encoder[rest]))) * rig.angle_per_count
    return start, 0.0 if run.accel is None else float(np.mean(run.accel[rest]))


def command_driven(rig: Rig, run: Run) -> Simulation:
    """The run's logged command through the rig; the right comparison for a sensor, closed loop or not."""
    start, offset = resting(rig, run)
    alone = replace(run, metadata=RunMetadata(start=run.metadata.start))
    return simulate_model(build(rig), alone, rounding=False, start_angle=start, accel_offset=offset)


def driven_motion(model: Model, run: Run, start: float, offset: float) -> tuple[tuple[np.ndarray, np.ndarray], Motion]:
    """Channels (encoder, accel) and motion that the logged command causes on the model."""
    rows, size = len(run.t), model.assembly.size
    state = initial_state(model, start, equilibrium=run.metadata.start == "equilibrium")
    controller = controller_arrays({"kind": "open"}, model.rig)
    encoder, accel, history = np.zeros(rows), np.zeros(rows), np.zeros((rows, state.z.size))
    stepper.run_ticks(model.plan, state, controller, run.reference, np.array(run.command), False, 0, offset, False,
                      (False, False), encoder, accel, history)
    full = history @ model.form.basis.T
    return (encoder, accel), Motion(full[:, :size], full[:, size:])
