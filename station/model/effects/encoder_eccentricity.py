"""The encoder's disc is not centred."""

import math
from typing import ClassVar

from station.model.effects.base import Effect, Stage, parameter


def counts(x, v, w, p, s, h):
    """a sin(x + phase), counts, added to the reading."""
    return p[0] * math.sin(x + p[1])


class EncoderEccentricity(Effect):
    """An error of the reading with one cycle per revolution."""

    name, title = "encoder_eccentricity", "encoder eccentricity"
    sites: ClassVar = ("encoder",)
    stage, law = Stage.ENCODER, counts
    absolute = "phase"
    picture = "angle"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 200}
    telling = ("the angle is wrong once per revolution and the acceleration is right; torque ripple and gravity by "
               "tilt move the arm itself")

    amplitude: float = parameter("counts", 0.0, neutral=0.0)
    phase: float = parameter("rad", -math.pi, math.pi, periodic=True)

    @classmethod
    def largest(cls, rig, at):
        """A tenth of the disc's radius out of centre (sin e/R): beyond it no track would stay under its reader."""
        return {"amplitude": 0.1 * rig.encoder.counts_per_revolution / (2.0 * math.pi)}

    @classmethod
    def guesses(cls, rig, at):
        return [{"amplitude": size, "phase": phase}
                for size in (2.0, 10.0) for phase in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)]
