"""The accelerometer clips."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def counts(x, v, w, p, s, h):
    """a -> min(max(a, -limit), limit), counts, offset included."""
    return min(max(x, -p[0]), p[0])


class AccelerometerSaturation(Effect):
    """Readings beyond a limit are cut."""

    name, title = "accelerometer_saturation", "accelerometer saturation"
    sites: ClassVar = ("accelerometer",)
    stage, law = Stage.ACCEL_COUNTS, counts
    picture = "acceleration"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 200}
    telling = "large peaks are cut at one level and small ones are right; a wrong accelerometer.gain scales both"

    limit: float = parameter("counts", 0.0, math.inf, neutral=math.inf, rounded=True)

    @classmethod
    def guesses(cls, rig, at):
        per_unit = abs(rig.accelerometer.gain)  # limits in m/s^2, from ten g to less than one
        return [{"limit": value * per_unit} for value in (105.0, 74.0, 52.0, 37.0, 26.0, 17.5, 10.5, 7.0)]
