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
        return [{"limit": value} for value in (120.0, 85.0, 60.0, 42.0, 30.0, 20.0, 12.0, 8.0)]
