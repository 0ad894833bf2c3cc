"""Torque ripple (cogging): the motor's torque varies with its angle."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter, torque_scale


def torque(x, v, w, p, s, h):
    """T = a sin(cycles x + phase), N m."""
    return p[0] * math.sin(p[1] * x + p[2])


class TorqueRipple(Effect):
    """A torque on the motor with a fixed number of cycles per revolution."""

    name, title = "torque_ripple", "torque ripple"
    sites: ClassVar = ("motor",)
    stage, law = Stage.TORQUE, torque
    absolute = "phase"
    picture = "angle"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 60}
    telling = ("a slow turn is pushed at the same angles every time, whatever the speed; Stribeck friction knows no "
               "angle, encoder eccentricity leaves the acceleration alone")

    amplitude: float = parameter("N m", 0.0, neutral=0.0)
    cycles: float = parameter("1/rev", 1.0, 200.0)
    phase: float = parameter("rad", -math.pi, math.pi, periodic=True)

    @classmethod
    def guesses(cls, rig, at):
        return [{"amplitude": 0.05 * torque_scale(rig), "cycles": cycles, "phase": phase}
                for cycles in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 14.0, 16.0, 20.0, 24.0, 30.0, 36.0)
                for phase in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)]
