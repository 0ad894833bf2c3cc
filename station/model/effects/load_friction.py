"""Load-dependent friction: gears rub in proportion to the torque that they carry."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def level(x, v, w, p, s, h):
    """Level fraction * |drive torque|, N m (as in models of gear friction, e.g. Dohring et al. 1993)."""
    return p[0] * w


class LoadFriction(Effect):
    """Opposes the motor's velocity with a fraction of the drive's torque; holds at rest; adds to other friction."""

    name, title = "load_friction", "load-dependent friction"
    sites: ClassVar = ("drive",)
    stage, law = Stage.FRICTION, level
    picture = "speed"
    experiment: ClassVar = {"kind": "step", "amplitude": 100, "controller": "lead"}
    telling = ("the motor is braked while the drive works hard and hardly while it coasts; Coulomb friction brakes "
               "alike in both")

    fraction: float = parameter("1", 0.0, 0.999, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"fraction": value} for value in (0.05, 0.2, 0.5)]
