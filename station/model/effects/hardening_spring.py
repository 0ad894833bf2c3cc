"""A spring that stiffens (or, negative, softens) with its deflection."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter, torque_scale


def torque(x, v, w, p, s, h):
    """T = k3 d^3, N m, added to the linear spring."""
    return p[0] * x * x * x


class HardeningSpring(Effect):
    """Cubic stiffness of the drive or the clamp."""

    name, title = "hardening_spring", "hardening spring"
    sites: ClassVar = ("drive", "clamp")
    stage, law = Stage.SPRING, torque
    picture = "deflection"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 200}
    telling = ("the resonance moves with the size of the swing; a wrong stiffness (drive.stiffness, clamp.stiffness)"
               " moves it alike at every size, backlash matters most in small swings")

    cubic: float = parameter("N m/rad^3", -1e15, 1e15, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        stiffness = getattr(rig, at).stiffness
        # A soft joint bends as far as tests move it, a stiff one as far as a fifth of the motor's torque bends it.
        reach = min(0.5 if at == "drive" else 0.1, 0.2 * torque_scale(rig) / stiffness)
        return [{"cubic": share * stiffness / reach**2} for share in (-0.3, 0.3, 3.0)]
