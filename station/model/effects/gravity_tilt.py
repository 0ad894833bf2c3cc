"""Gravity on a rig that is not level."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter, torque_scale


def torque(x, v, w, p, s, h):
    """T = -T0 sin(x - angle), N m: a pendulum about a tilted axis."""
    return -p[0] * math.sin(x - p[1])


class GravityTilt(Effect):
    """The axis is not upright, so the arm falls towards one angle."""

    name, title = "gravity_tilt", "gravity by tilt"
    sites: ClassVar = ("base",)
    stage, law = Stage.TORQUE, torque
    absolute = "angle"
    picture = "angle"
    experiment: ClassVar = {"kind": "step", "amplitude": 200, "controller": "p"}
    telling = ("held at several angles, the arm is pulled by the sine of the angle; a cable spring goes on growing, "
               "a command bias is the same everywhere")

    torque: float = parameter("N m", 0.0, neutral=0.0)
    angle: float = parameter("rad", -math.pi, math.pi, periodic=True)

    @classmethod
    def guesses(cls, rig, at):
        # A table that is not level, and a pendulum.
        return [{"torque": share * torque_scale(rig), "angle": angle}
                for share in (0.02, 0.3) for angle in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)]
