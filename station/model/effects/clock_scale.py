"""The board's clock is off."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


class ClockScale(Effect):
    """The true sample period is ratio / sample_rate; t stays index / sample_rate."""

    name, title = "clock_scale", "clock scale"
    sites: ClassVar = ("clock",)
    stage = Stage.CLOCK
    picture = "frequency"
    experiment: ClassVar = {}
    telling = ("angle and acceleration cannot tell it from wrong constants; host times logged beside the device's, "
               "over a long run, can")

    ratio: float = parameter("1", 0.1, 10.0, neutral=1.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"ratio": value} for value in (0.97, 1.03)]
