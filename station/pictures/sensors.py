"""Pictures of what a sensor or a clock reads, against what it should."""

from __future__ import annotations

import math

import numpy as np

from station.model.along import law_values
from station.model.effects import Effect, Stage
from station.model.simulate import build, simulate_model
from station.pictures.driven import command_driven, resting
from station.pictures.missing import missing_torque
from station.pictures.picture import Cause, Evidence, count, grid_over, thin


def readings(cause: Cause, effect: Effect) -> list[Evidence]:
    """Measured against simulated accelerometer."""
    x = np.concatenate([command_driven(cause.without, run).accel for run in cause.runs])
    grid = grid_over(x)
    law = None if effect.states else (grid, law_values(cause.extended, effect, grid))
    return [thin(f"Accelerometer, measured against simulated: {cause.title}", "acceleration",
                 "simulated without the effect (counts)", "measured (counts)", x,
                 np.concatenate([run.accel for run in cause.runs]), law,
                 f"Points: {count(cause.runs)}, simulated from the logged command. Line: the fitted law; without the "
                 "effect points would lie on the diagonal.")]


def centripetal(cause: Cause, effect: Effect) -> list[Evidence]:
    """What the accelerometer reads too much, against the base's speed squared."""
    rig = cause.extended
    assert rig.accelerometer is not None and rig.beam is not None
    speed = np.concatenate([missing_torque(cause.without, run, accelerometer=False).base_speed for run in cause.runs])
    y = np.concatenate([run.accel - command_driven(cause.without, run).accel for run in cause.runs])
    grid = np.linspace(0.0, float(np.max(np.abs(speed))), 200)
    law = None if effect.states else (grid**2, law_values(rig, effect, grid, 0.0, rig.beam.length))
    return [thin(f"Acceleration read beyond the simulated, against speed squared: {cause.title}", "speed",
                 "base speed squared (rad²/s²)", "measured - simulated (m/s²)", speed**2, y / rig.accelerometer.gain,
                 law, f"Points: {count(cause.runs)}; the speed is smoothed from command and encoder, the acceleration "
                 "simulated from the logged command. Line: the fitted law.")]


def eccentricity(cause: Cause, effect: Effect) -> list[Evidence]:
    """The encoder's error against the angle: the fit's residual with this effect's own part put back."""
    x, y, model = [], [], build(cause.extended)
    for run in cause.runs:
        start, offset = resting(cause.extended, run)
        reading = simulate_model(model, run, rounding=False, start_angle=start, accel_offset=offset).encoder
        angle = reading * cause.extended.angle_per_count
        x.append(angle)
        y.append(run.encoder - reading + law_values(cause.extended, effect, angle))
    angle = np.concatenate(x)
    grid = grid_over(angle)
    return [thin(f"Error of the encoder, against the angle: {cause.title}", "angle", "base angle (rad)",
                 "encoder error (counts)", angle, np.concatenate(y), (grid, law_values(cause.extended, effect, grid)),
                 f"Points: measured minus simulated, {count(cause.runs)}, with this effect's fitted part put back (a "
                 "partial residual: the angle comes from the extended rig, it cannot come from the encoder that is in "
                 "doubt). Line: the fitted law.")]


def clocks(cause: Cause) -> list[Evidence]:
    """Host clock against device clock, where a run holds both."""
    timed = [run for run in cause.runs if run.host_time is not None and run.device_time is not None]
    if not timed:
        return []
    run = max(timed, key=len)
    device = run.device_time - run.device_time[0]
    drift = run.host_time - run.host_time[0] - device
    slope = math.prod(e.values()["ratio"] for e in cause.extended.effects if e.stage is Stage.CLOCK) - 1.0
    grid = np.array([0.0, device[-1]])
    return [thin(f"Host clock minus device clock: {cause.title}", "time", "device time (s)", "drift (ms)", device,
                 1e3 * drift, (grid, 1e3 * slope * grid),
                 f"Run {run.name}. Line: the fitted ratio; latency of single samples shows as scatter above it.")]
