"""What a step test is judged by: overshoot, rise and settling, of a reference and the encoder's answer to it."""

from __future__ import annotations

import numpy as np

SETTLED = 0.02
"""Of the step: inside it for good, a step has settled."""


def step_row(reference: np.ndarray) -> int | None:
    """Row of a run's one step, None where the reference is not one step."""
    rows = np.flatnonzero(np.diff(reference))
    return int(rows[0]) + 1 if rows.size == 1 else None


def overshoot(reference: np.ndarray, encoder: np.ndarray) -> float | None:
    """100 (max theta - r)/(r - r before the step), percent; for a step down with the smallest theta."""
    row = step_row(reference)
    if row is None:
        return None
    before, after = reference[row - 1], reference[row]
    peak = np.max(encoder) if after > before else np.min(encoder)
    return float(100.0 * (peak - after) / (after - before)) + 0.0     # never a negative zero


def settling_time(reference: np.ndarray, encoder: np.ndarray, t: np.ndarray) -> float | None:
    """Last time outside +-2 % of the step, s from the step; None where the run ends outside."""
    row = step_row(reference)
    if row is None:
        return None
    size = abs(reference[row] - reference[row - 1])
    outside = np.flatnonzero(np.abs(encoder[row:] - reference[row]) > SETTLED * size)
    if outside.size == 0:
        return 0.0
    last = row + int(outside[-1])
    return None if last == len(t) - 1 else float(t[last] - t[row])


def rise_time(reference: np.ndarray, encoder: np.ndarray, t: np.ndarray) -> float | None:
    """Seconds from 10 % to 90 % of the step, between rows on straight lines; None where 90 % is not reached."""
    row = step_row(reference)
    if row is None:
        return None
    way, t = (encoder[row:] - reference[row - 1]) / (reference[row] - reference[row - 1]), t[row:]
    times = []
    for share in (0.1, 0.9):
        above = np.flatnonzero(way >= share)
        if not above.size:
            return None
        k = int(above[0])
        if k == 0:
            times.append(float(t[0]))
            continue
        low, high = float(way[k - 1]), float(way[k])
        times.append(float(t[k - 1] + (share - low) / (high - low) * (t[k] - t[k - 1])))
    return times[1] - times[0]
