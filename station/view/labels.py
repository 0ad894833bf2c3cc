"""Where to write the names of lines so that they cover nothing, on a phone and on a desk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_CANVASES = ((300.0, 225.0), (710.0, 320.0))
"""Width and height of the plot area, pixels: a phone's and a desk's."""
_LETTER, _HEIGHT, _REACH = 7.0, 16.0, 30.0
"""Width of a letter, height of a line of text and sideways length of a leader, pixels."""
_DROPS = (-64, -44, -28, 28, 44, 64)


@dataclass(frozen=True)
class Place:
    """A label's anchor (index into the line), its offset in pixels, and the side that it reads to."""

    index: int
    shift: float
    drop: float


def place_labels(t: np.ndarray, lines: dict[str, np.ndarray], texts: dict[str, str],
                 apart: np.ndarray) -> dict[str, Place]:
    """Choose a place for each text beside its line, best first where ``apart`` (rows) is large.

    Greedy: each text in turn takes the place that hides least of the lines and of the texts placed before it,
    summed over both canvases.
    """
    n = len(t)
    low, high = (f([f(line) for line in lines.values()]) for f in (np.min, np.max))
    span = (high - low) or 1.0
    across = (t - t[0]) / ((t[-1] - t[0]) or 1.0)
    samples = np.unique(np.linspace(0, n - 1, 400).astype(int))
    heights = {role: 0.05 + 0.9 * (high - line) / span for role, line in lines.items()}
    points = np.array([(across[i], h[i]) for h in heights.values() for i in samples])
    importance = apart / (apart.max() or 1.0)
    anchors = np.unique(np.linspace(0.06 * n, 0.94 * n, 30).astype(int))
    placed: dict[str, Place] = {}
    boxes: list[list[np.ndarray]] = [[] for _ in _CANVASES]
    for role, text in texts.items():
        best = min((Place(int(index), side * _REACH, drop) for index in anchors for side in (-1, 1) for drop in _DROPS),
                   key=lambda p: _cost(p, role, text, heights, across, points, boxes, importance))
        placed[role] = best
        for canvas, box in zip(_CANVASES, boxes, strict=True):
            box.append(_box(best, text, across[best.index], heights[role][best.index], canvas))
    return placed


def _box(place: Place, text: str, x: float, y: float, canvas: Sequence[float]) -> np.ndarray:
    left = x * canvas[0] + place.shift - (len(text) * _LETTER if place.shift < 0 else 0.0)
    middle = y * canvas[1] + place.drop
    return np.array([left - 2, middle - _HEIGHT / 2, left + len(text) * _LETTER + 2, middle + _HEIGHT / 2])


def _cost(place: Place, role: str, text: str, heights: dict[str, np.ndarray], across: np.ndarray,
          points: np.ndarray, boxes: list[list[np.ndarray]], importance: np.ndarray) -> float:
    x, y = across[place.index], heights[role][place.index]
    cost = -12.0 * importance[place.index] + 0.05 * abs(place.drop)
    for canvas, taken in zip(_CANVASES, boxes, strict=True):
        box = _box(place, text, x, y, canvas)
        px, py = points[:, 0] * canvas[0], points[:, 1] * canvas[1]
        cost += np.count_nonzero((px > box[0]) & (px < box[2]) & (py > box[1]) & (py < box[3]))
        if box[0] < 0 or box[2] > canvas[0] or box[1] < 0 or box[3] > canvas[1]:
            cost += 500.0
        for other in taken:
            if box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3]:
                cost += 500.0
    return float(cost)
