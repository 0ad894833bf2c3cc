"""What is asked of a test before its device is armed."""

from __future__ import annotations

import numpy as np

from station.control.compensators import Compensator
from station.control.references import LEAST_REST
from station.errors import UsageError

FIRST_COMMAND_SHARE = 0.1
"""A test whose first command is a larger share of the limit than this does not begin at rest."""


def require_rest(reference: np.ndarray, rate: float, open_loop: bool) -> None:
    """UsageError where the reference (counts) does not rest for LEAST_REST seconds at its beginning.

    Rest is a constant reference; in open loop, where the reference is the command, it is 0.
    """
    beginning = reference[:round(LEAST_REST * rate)]
    level = 0.0 if open_loop else reference[0]
    if len(beginning) < round(LEAST_REST * rate) or np.any(beginning != level):
        raise UsageError(f"reference: a test begins with at least {LEAST_REST:g} s at rest "
                         f"({'command 0' if open_loop else 'a constant reference'})")


def require_small_first_command(url: str, rate: float, compensator: Compensator, reference: float, encoder: float,
                                accel_zero: float) -> None:
    """UsageError where the command (counts) that a test begins with is beyond FIRST_COMMAND_SHARE of the limit."""
    fresh = Compensator.from_spec(compensator.spec, rate, compensator.limit)
    fresh.reset(accel_zero)
    first = fresh.step(reference, encoder, accel_zero)
    if abs(first) > FIRST_COMMAND_SHARE * compensator.limit:
        raise UsageError(f"{url}: the first command would be {first:.0f} counts, more than "
                         f"{100.0 * FIRST_COMMAND_SHARE:.0f} % of the limit of {compensator.limit:g}: the arm rests at "
                         f"{encoder:g} counts, the reference begins at {reference:g}; bring the arm there, or let the "
                         "reference begin where the arm is")
