"""The amplifier's gain depends on the size of the command."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def command(x, v, w, p, s, h):
    """c -> c |c/limit|^exponent, counts; w is amplifier.limit."""
    if x == 0.0:
        return 0.0
    return x * abs(x / w) ** p[0]


class GainCurve(Effect):
    """A power law that leaves full scale as it is: exponent > 0 weakens small commands, < 0 strengthens them."""

    name, title = "gain_curve", "gain curve"
    sites: ClassVar = ("amplifier",)
    stage, law, order = Stage.COMMAND, command, 4.0
    picture = "command"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 40}
    telling = ("the same pulse, small and large, is answered by different gains; a dead zone takes the same counts "
               "off both, a wrong motor.gain changes both alike")

    exponent: float = parameter("1", -0.99, 10.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"exponent": value} for value in (-0.3, -0.08, 0.08, 0.3)]
