"""One inertia whose loop holds it in its place against a torque that comes and goes; own code, real sticking.

J w' = g u - b w - friction + d, with d an Ornstein-Uhlenbeck torque, by semi-implicit Euler steps of 0.1 ms; the
controller is proportional, with a backward difference of the reading as its speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from station.runs.run import Run, RunMetadata

STEP = 1e-4
"""Longest step, s."""
BANDWIDTH, DAMPING = 12.0, 0.6
"""Of the loop, rad/s, and of its poles."""
RUNS = 4
LEVEL, CORRELATION = 0.004, 0.1
"""Standard deviation of the torque that comes and goes, of the stall torque (2 % of what commands ask), and s."""


@dataclass(frozen=True)
class Sensor:
    """How a rig is read."""

    rate: float
    """Hz."""
    counts: float
    """Per revolution."""
    noise: float = 0.0
    """Standard deviation before rounding, counts."""
    seconds: float = 5.0


@njit(cache=True)
def _test(reference, gains, rig, disturbance, noise, count, limit, step, every):
    proportional, rate_gain = gains
    inertia, damping, friction, gain = rig
    angle, speed, command, last = 0.0, 0.0, 0.0, 0.0
    encoder, commands = np.empty(reference.size), np.empty(reference.size)
    for row in range(reference.size):
        encoder[row] = math.floor((angle / count) + noise[row] + 0.5)
        seen = encoder[row] * count
        rate, last = (seen - last) / (step * every), seen
        command = min(max(proportional * (reference[row] - seen) - rate_gain * rate, -limit), limit)
        commands[row] = command
        for _ in range(every):
            free = speed + step * (gain * command - damping * speed + disturbance[row]) / inertia
            braked = step * friction / inertia
            speed = 0.0 if abs(free) <= braked else free - math.copysign(braked, free)
            angle += step * speed
    return encoder, commands


def held_axis(seed: int, sensor: Sensor, friction: float = 0.0, limit: float = 255.0,
              ) -> tuple[dict[str, Any], list[Run]]:
    """A nominal rig, wrong by its uncertainty, and its runs: steps that are held, and sweeps, their controller untold.

    ``friction``: Coulomb's at the motor, a share of the stall torque.
    """
    rng = np.random.default_rng(seed)
    inertia = 1e-3 * rng.uniform(0.8, 1.2)
    damping, stall = inertia / rng.uniform(0.1, 0.4), 200.0 * inertia * rng.uniform(0.8, 1.2)
    gain, count = stall / limit, 2.0 * math.pi / sensor.counts
    every = math.ceil(1.0 / (sensor.rate * STEP) - 1e-9)
    rows = round(sensor.seconds * sensor.rate)
    t, decay = np.arange(rows) / sensor.rate, math.exp(-1.0 / (sensor.rate * CORRELATION))
    gains = (inertia * BANDWIDTH**2 / gain, max(2.0 * DAMPING * BANDWIDTH * inertia - damping, 0.0) / gain)
    runs = []
    for k in range(RUNS):
        size = rng.uniform(0.5, 1.5)
        swept = np.sin(2.0 * np.pi * np.cumsum(np.linspace(0.3, 3.0, rows)) / sensor.rate)
        reference = size * (swept if k % 2 else (t > 0.2).astype(float))
        disturbance = np.zeros(rows)
        for i, drawn in enumerate(rng.standard_normal(rows)):
            disturbance[i] = decay * disturbance[i - 1] + math.sqrt(1.0 - decay**2) * drawn
        encoder, command = _test(reference, gains, (inertia, damping, friction * stall, gain),
                                 LEVEL * stall * disturbance, sensor.noise * rng.standard_normal(rows), count, limit,
                                 1.0 / (sensor.rate * every), every)
        runs.append(Run(f"{'sweep' if k % 2 else 'step'} {k}", t, reference / count, command, encoder, None,
                        RunMetadata(rig="axis", controller={"kind": "unknown"}, rounding=False)))

    def told(true: float, sigma: float) -> float:
        return true * float(np.clip(rng.normal(1.0, sigma), 1.0 - 1.8 * sigma, 1.0 + 1.8 * sigma))

    rig = {
        "name": "axis", "sample_rate": sensor.rate, "amplifier": {"limit": limit},
        "motor": {"inertia": told(inertia, 0.1), "damping": told(damping, 0.2), "gain": told(gain, 0.05)},
        "encoder": {"counts_per_revolution": sensor.counts}, "uncertainty": {"default": 0.1, "motor.damping": 0.4}}
    return rig, runs
