"""Stribeck friction: more at rest than in motion."""

import math
from typing import ClassVar

from pydantic import model_validator

from station.model.effects.base import Effect, Stage, parameter, torque_scale


def level(x, v, w, p, s, h):
    """Level static + (coulomb - static)(1 - exp(-(w/ws)^2)), N m (Armstrong-Helouvry et al. 1994)."""
    ratio = x / p[2]
    return p[0] + (p[1] - p[0]) * (1.0 - math.exp(-ratio * ratio))


class StribeckFriction(Effect):
    """Opposes the velocity with a level that falls from static to Coulomb; holds up to static at rest."""

    name, title = "stribeck_friction", "Stribeck friction"
    sites: ClassVar = ("motor",)
    stage, law = Stage.FRICTION, level
    simpler: ClassVar = {"coulomb_friction": {"torque": "coulomb_torque"}}
    picture = "speed"
    experiment: ClassVar = {"kind": "triangle", "amplitude": 60}
    telling = "slow reversals stick and break loose; Coulomb friction has the same level before and after"

    static_torque: float = parameter("N m", 0.0, neutral=0.0)
    coulomb_torque: float = parameter("N m", 0.0, neutral=0.0)
    stribeck_velocity: float = parameter("rad/s", 1e-4, 100.0)

    @model_validator(mode="after")
    def _ordered(self):
        if self.static_torque < self.coulomb_torque:
            raise ValueError("static_torque must be at least coulomb_torque")
        return self

    @classmethod
    def ordered(cls, values):
        return values | {"static_torque": max(values["static_torque"], values["coulomb_torque"])}

    @classmethod
    def guesses(cls, rig, at):
        scale = torque_scale(rig)
        return [{"static_torque": 2.0 * share * scale, "coulomb_torque": share * scale, "stribeck_velocity": speed}
                for share in (0.01, 0.05) for speed in (0.2, 1.0)]
