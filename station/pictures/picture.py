"""What every picture of a cause is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from station.model.effects import Stage
from station.rig import Rig
from station.runs.run import Run

POINTS = 2000
"""Most points in a picture."""
PLACES = 400
"""At which a law is drawn."""
TOP = 0.25
"""Share of the sample rate up to which spectra and modes are told: half of Nyquist's."""
DELAYS = (Stage.INPUT_DELAY, Stage.ENCODER_DELAY, Stage.ACCEL_DELAY)


@dataclass(frozen=True)
class Evidence:
    """A picture specific to a cause: points, and the law drawn through them."""

    title: str
    kind: str
    xlabel: str
    ylabel: str
    x: np.ndarray
    y: np.ndarray
    law_x: np.ndarray | None = None
    law_y: np.ndarray | None = None
    note: str = ""
    without_y: np.ndarray | None = None
    """The rig without the cause, at the places of the law, where the picture shows both."""

    @property
    def drawn(self) -> bool:
        """Whether there is anything to draw; where not, the note says why."""
        return len(self.x) > 0


class Cause(NamedTuple):
    """A cause's title, the extended rig that holds it, the same rig without it, and the runs."""

    title: str
    extended: Rig
    without: Rig
    runs: list[Run]


def thin(title: str, kind: str, xlabel: str, ylabel: str, x: np.ndarray, y: np.ndarray,
         law: tuple[np.ndarray, np.ndarray] | None = None, note: str = "") -> Evidence:
    """A picture of at most POINTS points."""
    every = slice(None, None, max(-(-len(x) // POINTS), 1))
    law_x, law_y = law or (None, None)
    return Evidence(title, kind, xlabel, ylabel, x[every], y[every], law_x, law_y, note)


def grid_over(x: np.ndarray) -> np.ndarray:
    """PLACES over the range of x, and both sides of 0."""
    low, high = float(np.min(x)), float(np.max(x))
    grid = np.linspace(low, high, PLACES)
    tiny = 1e-9 * max(abs(low), abs(high), 1e-9)
    return np.sort(np.concatenate([grid, [-tiny, tiny]])) if low < 0.0 < high else grid


def count(runs: Sequence[Run]) -> str:
    return "1 run" if len(runs) == 1 else f"{len(runs)} runs"
