"""The amplifier drives one way harder than the other."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def command(x, v, w, p, s, h):
    """c -> ratio c for c < 0, counts."""
    return x * p[0] if x < 0.0 else x


class GainAsymmetry(Effect):
    """Negative commands are multiplied by a ratio."""

    name, title = "gain_asymmetry", "gain asymmetry"
    sites: ClassVar = ("amplifier",)
    stage, law, order = Stage.COMMAND, command, 5.0
    picture = "command"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 100}
    telling = ("the same pulse either way turns the arm by different angles, in one ratio at every size; a command "
               "bias adds the same to both")

    ratio: float = parameter("1", 0.01, 100.0, neutral=1.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"ratio": value} for value in (0.75, 0.93, 1.07, 1.35)]
