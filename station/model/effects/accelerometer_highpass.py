"""AC coupling of the accelerometer."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def acceleration(x, v, w, p, s, h):
    """y = x - z with tau z' + z = x, exact for x linear over h; v is x one step before; m/s^2."""
    if p[0] == math.inf:
        return x
    decay = math.exp(-h / p[0])
    slope = (x - v) * p[0] / h
    s[0] = x - slope + (s[0] - v + slope) * decay
    return x - s[0]


class AccelerometerHighpass(Effect):
    """First-order high-pass: slow accelerations fade from the reading."""

    name, title = "accelerometer_highpass", "accelerometer high-pass"
    sites: ClassVar = ("accelerometer",)
    stage, law, order, states = Stage.ACCEL_FILTER, acceleration, 1.0, 1
    picture = "frequency"
    experiment: ClassVar = {"kind": "sweep", "amplitude": 50}
    telling = ("slow accelerations read small and early, fast ones right; a wrong accelerometer.gain is wrong at all"
               " frequencies alike")

    time_constant: float = parameter("s", 1e-4, math.inf, neutral=math.inf)

    @classmethod
    def guesses(cls, rig, at):
        return [{"time_constant": value} for value in (1.0, 0.2, 0.04)]
