"""The command acts later than the loop's own timing says."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


class InputDelay(Effect):
    """A pure delay of the command, fractions of a sample included."""

    name, title = "input_delay", "input delay"
    sites: ClassVar = ("amplifier",)
    stage, order = Stage.INPUT_DELAY, 1.0
    picture = "frequency"
    experiment: ClassVar = {"kind": "step", "amplitude": 150, "controller": "lead"}
    telling = ("encoder and accelerometer come late together, at full size; an actuator lag takes size off fast "
               "commands, an encoder delay shifts the encoder alone")

    time: float = parameter("s", 0.0, 0.2, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"time": share * rig.period} for share in (0.3, 1.5, 5.0)]
