"""The encoder reads late."""

from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


class EncoderDelay(Effect):
    """A pure delay of the encoder's reading; before t = delay the starting reading holds."""

    name, title = "encoder_delay", "encoder delay"
    sites: ClassVar = ("encoder",)
    stage = Stage.ENCODER_DELAY
    picture = "frequency"
    experiment: ClassVar = {"kind": "step", "amplitude": 150, "controller": "lead"}
    telling = "the encoder comes late against the accelerometer; an input delay shifts both together"

    time: float = parameter("s", 0.0, 0.2, neutral=0.0)

    @classmethod
    def guesses(cls, rig, at):
        return [{"time": share * rig.period} for share in (0.3, 1.5, 5.0)]
