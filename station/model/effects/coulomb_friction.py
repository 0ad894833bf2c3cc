"""Coulomb friction: constant torque against the velocity, which holds at rest."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter, torque_scale


def level(x, v, w, p, s, h):
    """Friction level Fc, N m, the same at every speed (Coulomb 1785)."""
    return p[0]


class CoulombFriction(Effect):
    """T = -Fc sign(w) while moving; whatever is needed up to Fc at rest."""

    name, title = "coulomb_friction", "Coulomb friction"
    sites: ClassVar = ("motor", "base")
    stage, law = Stage.FRICTION, level
    picture = "speed"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 60}
    telling = ("a coasting arm is braked by the same torque at every speed and then held; a dead zone leaves a "
               "coasting arm alone, sublinear drag and a wrong motor.damping fade with the speed")

    torque: float = parameter("N m", 0.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"torque": share * torque_scale(rig)} for share in (0.005, 0.03, 0.12)]
