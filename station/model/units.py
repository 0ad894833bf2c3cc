"""Units of a rig's constants, for tables, files and the analysis of dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

UNITS = {"motor.inertia": "kg m^2", "motor.damping": "N m s/rad", "motor.gain": "N m/count",
         "drive.stiffness": "N m/rad", "drive.damping": "N m s/rad", "base.inertia": "kg m^2",
         "clamp.stiffness": "N m/rad", "clamp.damping": "N m s/rad", "beam.mass_per_length": "kg/m",
         "beam.length": "m", "beam.flexural_rigidity": "N m^2", "beam.damping": "s",
         "beam.rigidity_1": "1", "beam.rigidity_2": "1", "beam.rigidity_3": "1",
         "tip.mass": "kg", "tip.inertia": "kg m^2", "accelerometer.gain": "counts s^2/m"}
_BASE = {"N": (1, -1, 0), "kg": (1, -2, 2), "m": (0, 1, 0), "s": (0, 0, 1),
         **dict.fromkeys(("1", "rad", "rev", "count", "counts"), (0, 0, 0))}


class UnknownUnitError(ValueError):
    """A unit that is not made of N, kg, m, s, rad, rev and counts."""


@cache
def dimension(unit: str) -> tuple[int, int, int]:
    """Powers of (torque, length, time) in a unit such as "N m s^2/rad^2"; angles and counts are numbers."""
    total = np.zeros(3, dtype=int)
    over, *under = unit.split("/")
    for sign, part in ((1, over), *((-1, p) for p in under)):
        for token in part.split():
            name, _, power = token.partition("^")
            if name not in _BASE:
                raise UnknownUnitError(f"{unit!r}: {name!r} is none of {', '.join(_BASE)}")
            total += sign * int(power or 1) * np.array(_BASE[name])
    torque, length, time = (int(p) for p in total)
    return torque, length, time


def powers(paths: Sequence[str], which: int) -> np.ndarray:
    """Power of torque (0), length (1) or time (2) in each constant."""
    return np.array([float(dimension(UNITS[path])[which]) for path in paths])
