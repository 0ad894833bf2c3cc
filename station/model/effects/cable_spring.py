"""A cable that pulls the arm towards its rest angle."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter, torque_scale


def torque(x, v, w, p, s, h):
    """T = -k (x - rest), N m."""
    return -p[0] * (x - p[1])


class CableSpring(Effect):
    """The sensor's cable acts as a weak spring to ground."""

    name, title = "cable_spring", "cable spring"
    sites: ClassVar = ("base",)
    stage, law = Stage.TORQUE, torque
    absolute = "rest"
    picture = "angle"
    experiment: ClassVar = {"kind": "step", "amplitude": 200, "controller": "p"}
    telling = ("held at several angles, the arm is pulled the harder the farther it is from rest; a command bias is "
               "the same at every angle, gravity by tilt turns back within a revolution")

    stiffness: float = parameter("N m/rad", 0.0, neutral=0.0)
    rest: float = parameter("rad", -20.0 * math.pi, 20.0 * math.pi)

    @classmethod
    def guesses(cls, rig, at):
        return [{"stiffness": share * torque_scale(rig), "rest": rest}
                for share in (0.01, 0.1) for rest in (0.0, 0.5, -0.5)]
