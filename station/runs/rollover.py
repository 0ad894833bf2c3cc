"""An encoder's counter that rolls over: a jump of its whole range between two rows of a slow motion."""

from __future__ import annotations

import numpy as np

COUNTERS = tuple(2**bits for bits in (8, 12, 16, 24, 32))
SLOW = 0.125
"""Largest share of its range that a counter moves from row to row elsewhere."""


def rollover(encoder: np.ndarray, turn: float | None = None) -> tuple[int, float] | None:
    """The first row at which a counter rolled over, and its range (counts); None where none did.

    ``turn``: the rig's counts per revolution, where they are known.  All readings lie within one range; a jump is of
    nearly all of it; without the jumps no row moves by more than an eighth of it; and where they are the motion
    changes by no more than elsewhere, but for two counts.
    """
    steps = np.diff(encoder)
    for counter in sorted({*COUNTERS, *([float(turn)] if turn else [])}):
        turns = np.round(steps / counter)
        at = np.flatnonzero(turns)
        if at.size and np.ptp(encoder) < counter and _smooth(steps - counter * turns, at, counter):
            return int(at[0]) + 1, float(counter)
    return None


def _smooth(steps: np.ndarray, at: np.ndarray, counter: float) -> bool:
    """Whether unwrapped steps are small, and change where the counter rolled over as they do elsewhere."""
    if np.abs(steps).max() > SLOW * counter:
        return False
    changes = np.abs(np.diff(steps))
    there = np.zeros(len(changes), dtype=bool)
    for beside in (at - 1, at):
        there[beside[(beside >= 0) & (beside < len(changes))]] = True
    return bool(changes[there].max(initial=0.0) <= 2.0 + changes[~there].max(initial=0.0))


def rollover_fault(encoder: np.ndarray, found: tuple[int, float], where: str) -> str:
    """What is wrong and what to do, in one line; ``where`` is the row's place."""
    row, counter = found
    return (f"column encoder, {where}: {encoder[row]:.12g} after {encoder[row - 1]:.12g}, a counter of {counter:.12g} "
            f"that rolls over; unwrap it, as by numpy.unwrap(encoder, period={counter:.12g})")
