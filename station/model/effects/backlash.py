"""Backlash: play in the drive."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def deflection(x, v, w, p, s, h):
    """What of the deflection exceeds the gap: d - sign(d) gap/2 outside +-gap/2, else 0, rad."""
    half = 0.5 * p[0]
    if x > half:
        return x - half
    if x < -half:
        return x + half
    return 0.0


class Backlash(Effect):
    """The drive carries torque, spring and damper, only outside its gap."""

    name, title = "backlash", "backlash"
    sites: ClassVar = ("drive",)
    stage, law = Stage.GAP, deflection
    picture = "deflection"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 100}
    telling = ("each reversal loses the same angle, so that small moves suffer most; a dead zone loses counts "
               "without a reversal too, a hardening spring leaves small moves alone")

    gap: float = parameter("rad", 0.0, 6.3, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"gap": value} for value in (0.002, 0.005, 0.012, 0.03, 0.07, 0.2)]
