"""Drag that grows less than in proportion to the speed."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def torque(x, v, w, p, s, h):
    """T = -k w / (1 + |w|/ws), N m."""
    return -p[0] * v / (1.0 + abs(v) / p[1])


class SublinearDrag(Effect):
    """Viscous at small speeds, saturating towards k ws; on top of motor.damping."""

    name, title = "sublinear_drag", "sublinear drag"
    sites: ClassVar = ("motor",)
    stage, law = Stage.TORQUE, torque
    picture = "speed"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 150}
    telling = ("the braking levels off at speed and vanishes at rest; a wrong motor.damping goes on growing, Coulomb"
               " friction also holds at rest")

    coefficient: float = parameter("N m s/rad", 0.0, neutral=0.0)
    speed: float = parameter("rad/s", 1e-3, math.inf, neutral=math.inf)

    @classmethod
    def cases(cls, rig, at, values):
        """Where it levels off at once it is Coulomb friction, but for rest."""
        return {("coulomb_friction", at): {"torque": values["coefficient"] * values["speed"]}}

    @classmethod
    def guesses(cls, rig, at):
        scale = rig.motor.damping or abs(rig.motor.gain)
        return [{"coefficient": share * scale, "speed": speed} for share in (0.1, 0.5) for speed in (0.5, 3.0)]
