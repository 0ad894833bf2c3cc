"""Dead zone of the amplifier: small commands do nothing."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def command(x, v, w, p, s, h):
    """c -> 0 inside +-width, c -+ width outside, counts."""
    if x > p[0]:
        return x - p[0]
    if x < -p[0]:
        return x + p[0]
    return 0.0


class DeadZone(Effect):
    """Commands within the width are lost, larger ones are reduced by it."""

    name, title = "dead_zone", "dead zone"
    sites: ClassVar = ("amplifier",)
    stage, law, order = Stage.COMMAND, command, 2.0
    picture = "command"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 20}
    telling = ("small commands do nothing even while the arm moves; Coulomb friction brakes a coasting arm too, a "
               "gain curve has no edge")

    width: float = parameter("counts", 0.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"width": share * rig.amplifier.limit} for share in (0.005, 0.03, 0.12)]
