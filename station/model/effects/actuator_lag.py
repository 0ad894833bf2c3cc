"""First-order lag from command to torque: the motor's electrical time constant."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def command(x, v, w, p, s, h):
    """tau y' + y = c, exact for a constant c over h; returns the mean of y over h, counts."""
    if p[0] <= 0.0:
        return x
    gap, decay = s[0] - x, math.exp(-h / p[0])
    s[0] = x + gap * decay
    if h <= 0.0:
        return s[0]
    return x + gap * (1.0 - decay) * p[0] / h


class ActuatorLag(Effect):
    """The torque follows the command with a time constant."""

    name, title = "actuator_lag", "actuator lag"
    sites: ClassVar = ("amplifier",)
    stage, law, order, states = Stage.COMMAND, command, 7.0, 1
    picture = "frequency"
    experiment: ClassVar = {"kind": "step", "amplitude": 150, "controller": "lead"}
    telling = ("fast commands lose size as well as time; an input delay keeps their size, a wrong motor.inertia also"
               " slows what the arm does by itself")

    time_constant: float = parameter("s", 0.0, 1.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"time_constant": value} for value in (0.5 * rig.period, 2.0 * rig.period, 8.0 * rig.period)]
