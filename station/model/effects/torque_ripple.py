"""Torque ripple (cogging): the motor's torque varies with its angle."""

import math
from typing import ClassVar

from station.model.effects.base import SHOWN, Effect, Stage, parameter, torque_scale

CYCLES = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 14.0, 16.0, 20.0, 24.0, 30.0, 36.0, 42.0, 48.0, 50.0,
          60.0, 72.0, 84.0, 100.0, 120.0, 144.0, 168.0, 200.0, *(2.0 * math.pi / lead for lead in
                                                                 (0.040, 0.020, 0.010, 0.005, 0.0025)))
"""Per turn: eccentricity, poles, commutation; from 12 on also common multiples of slots and poles, by which a motor
cogs (12 and 14: 84), and the 50 teeth of a stepping motor, four steps each; of an axis in metres the turns of a ball
screw of one of the preferred leads, 40 to 2.5 mm (ISO 3408-2)."""


def torque(x, v, w, p, s, h):
    """T = a sin(cycles x + phase), N m."""
    return p[0] * math.sin(p[1] * x + p[2])


class TorqueRipple(Effect):
    """A torque on the motor with a fixed number of cycles per revolution."""

    name, title = "torque_ripple", "torque ripple"
    sites: ClassVar = ("motor",)
    stage, law = Stage.TORQUE, torque
    absolute, waves = "phase", "cycles"
    picture = "angle"
    experiment: ClassVar = {"kind": "pulse", "amplitude": 60}
    telling = ("a slow turn is pushed at the same angles every time, whatever the speed; Stribeck friction knows no "
               "angle, encoder eccentricity leaves the acceleration alone")

    amplitude: float = parameter("N m", 0.0, neutral=0.0)
    cycles: float = parameter("1/rev", 1.0, 10000.0)
    phase: float = parameter("rad", -math.pi, math.pi, periodic=True)

    @classmethod
    def cases(cls, rig, at, values):
        """Without a drive one cycle per turn is a tilt: a sin(x + phi) = -a sin(x - (pi - phi))."""
        if rig.drive is not None or round(values["cycles"]) != 1:
            return {}
        angle = math.remainder(math.pi - values["phase"], math.tau)
        return {("gravity_tilt", "base"): {"torque": values["amplitude"], "angle": angle}}

    @classmethod
    def guesses(cls, rig, at):
        return [{"amplitude": 0.05 * torque_scale(rig), "cycles": cycles, "phase": phase}
                for cycles in CYCLES if cycles <= SHOWN * rig.encoder.counts_per_revolution
                for phase in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)]
