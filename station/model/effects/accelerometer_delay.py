"""The accelerometer reads late."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


class AccelerometerDelay(Effect):
    """A pure delay of the accelerometer's reading."""

    name, title = "accelerometer_delay", "accelerometer delay"
    sites: ClassVar = ("accelerometer",)
    stage = Stage.ACCEL_DELAY
    picture = "frequency"
    experiment: ClassVar = {"kind": "sweep", "amplitude": 50}
    telling = "the phase grows with frequency while the size stays; an accelerometer lag loses size too"

    time: float = parameter("s", 0.0, 0.2, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"time": value} for value in (0.001, 0.004, 0.012)]
