"""Integers are rounded half up, everywhere (the rule of the board's integer arithmetic)."""

import math


def round_half_up(value: float) -> int:
    """Return the integer nearest to ``value``; a half goes up: 0.5 -> 1, -0.5 -> 0."""
    return math.floor(value + 0.5)
