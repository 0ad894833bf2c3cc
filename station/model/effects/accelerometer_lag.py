"""A low-pass in the accelerometer's path."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def acceleration(x, v, w, p, s, h):
    """tau y' + y = x, exact for x linear over h; v is x one step before; m/s^2."""
    if p[0] <= 0.0:
        return x
    slope = (x - v) * p[0] / h
    s[0] = x - slope + (s[0] - v + slope) * math.exp(-h / p[0])
    return s[0]


class AccelerometerLag(Effect):
    """First-order low-pass: fast accelerations read late and small."""

    name, title = "accelerometer_lag", "accelerometer lag"
    sites: ClassVar = ("accelerometer",)
    stage, law, order, states = Stage.ACCEL_FILTER, acceleration, 2.0, 1
    picture = "frequency"
    experiment: ClassVar = {"kind": "sweep", "amplitude": 50}
    telling = ("fast accelerations read small as well as late; an accelerometer delay keeps their size, a wrong "
               "beam.damping changes the resonance alone")

    time_constant: float = parameter("s", 0.0, 1.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"time_constant": value} for value in (0.001, 0.004, 0.015)]
