"""A constant added to every command by the amplifier."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def command(x, v, w, p, s, h):
    """c -> c + offset, counts."""
    return x + p[0]


class CommandBias(Effect):
    """The amplifier's zero is off: the motor is driven at command 0."""

    name, title = "command_bias", "command bias"
    sites: ClassVar = ("amplifier",)
    stage, law, order = Stage.COMMAND, command, 6.0
    picture = "time"
    experiment: ClassVar = {"kind": "step", "amplitude": 30, "controller": "p"}
    telling = ("the arm stands off by the same torque at every angle; a cable spring and gravity by tilt depend on "
               "the angle, gain asymmetry on the size of the command")
    alike = ("Any other constant torque on the motor does what a command bias does: a weight on a linear axis, or half "
             "of what friction one way differs by from friction the other way.")

    offset: float = parameter("counts", -1000.0, 1000.0, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"offset": share * rig.amplifier.limit} for share in (-0.08, -0.01, 0.01, 0.08)]
