"""The accelerometer's axis is turned, so that it also sees the centripetal acceleration."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def acceleration(x, v, w, p, s, h):
    """fraction length w_base^2, m/s^2; w is beam.length."""
    return p[0] * w * x * x


class AccelerometerCentripetal(Effect):
    """Adds a fraction of length times the base speed squared."""

    name, title = "accelerometer_centripetal", "centripetal acceleration"
    sites: ClassVar = ("accelerometer",)
    stage, law = Stage.ACCEL_INPUT, acceleration
    picture = "speed"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 200}
    telling = ("fast turns push the reading to one side, by the speed squared, whichever way the arm turns; a wrong "
               "accelerometer.gain changes sign with the acceleration")

    fraction: float = parameter("1", -2.0, 2.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"fraction": value} for value in (-0.2, 0.2)]
