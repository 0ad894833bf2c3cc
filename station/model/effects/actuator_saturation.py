"""The amplifier clips below the commanded limit."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def command(x, v, w, p, s, h):
    """c -> min(max(c, -limit), limit), counts."""
    return min(max(x, -p[0]), p[0])


class ActuatorSaturation(Effect):
    """The drive's voltage reaches its rail before the command does."""

    name, title = "actuator_saturation", "actuator saturation"
    sites: ClassVar = ("amplifier",)
    stage, law, order = Stage.COMMAND, command, 3.0
    picture = "command"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 200}
    telling = ("commands beyond the limit do no more than the limit and smaller ones are right; a gain curve bends "
               "at every size, a wrong motor.gain scales all")

    limit: float = parameter("counts", 0.0, math.inf, neutral=math.inf)

    @classmethod
    def guesses(cls, rig, at):
        return [{"limit": share * rig.amplifier.limit} for share in (0.97, 0.9, 0.78, 0.62, 0.45, 0.25)]
