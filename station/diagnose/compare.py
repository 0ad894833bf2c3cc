"""Measured runs against a rig's simulation of the same tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from station import markup
from station.diagnose.measures import measures
from station.diagnose.result import CHANNELS
from station.diagnose.whole_run import not_closed, seconds_ahead, settled_run, whole_run
from station.estimation.dataset import Dataset, dataset
from station.model.simulate import Model, Simulation, build
from station.rig import Rig
from station.runs.run import Run

FAR = 1e9
"""What a simulation is away, counts, that has run off."""


@dataclass(frozen=True)
class Comparison:
    """Runs, their gaps filled, and the simulations beside them."""

    rig: Rig
    runs: tuple[Run, ...]
    simulations: tuple[Simulation, ...]
    rows: tuple[np.ndarray, ...]
    """(n) of each those that count: that were logged, and not those from which the state of a rig in motion is told."""
    seconds_ahead: tuple[float | None, ...]
    """How far ahead each is predicted, where its loop cannot be closed again; None: it is simulated as a whole."""
    not_closed: tuple[str, ...]
    """Why its loop cannot be closed again, as a clause; empty where it can."""

    @property
    def measures(self) -> list[dict[str, Any]]:
        """As ``compare --json`` has it: per run nrmse of each channel, and step measures, measured and simulated."""
        return [measures(*one) for one in zip(self.runs, self.simulations, self.rows, self.seconds_ahead, strict=True)]

    def _repr_html_(self) -> str:
        rows = []
        for found in self.measures:
            error = [f"{100.0 * found[c]['nrmse']:.1f} %" if c in found else "-" for c in CHANNELS]
            step = [f"{found[side]['overshoot_percent']:.1f} %" if found[side] else "-"
                    for side in ("measured", "simulated")]
            rows.append((found["run"], *error, *step))
        plots = []
        for run, made in zip(self.runs, self.simulations, strict=True):
            lines = {"measured": run.encoder, "simulated": made.encoder}
            plots.append(f"<div>{markup.legend(lines)}</div><div>{markup.plot(run.t, lines, run.name)}</div>")
        return markup.table(("run", "angle error", "acceleration error", "overshoot measured", "simulated"), rows,
                            f"Error in % of the signal's spread, simulated by {self.rig.name}") + "".join(plots)


def compare(rig: Rig, runs: Sequence[Run], progress: Callable[[float], None] = lambda share: None) -> Comparison:
    """Simulate the tests of runs on a rig, starting angle and accelerometer offset estimated per run.

    Where the first readings themselves suit a run better than that estimate, they are taken: a run that the rig
    simulated compares to itself by 0.  A loop that cannot be closed again is predicted a time ahead.  WorkError: a
    run's rate is not the rig's, or its controller reads a sensor that the rig has not.  ``progress`` is told the share
    that is done.
    """
    data = dataset(rig, runs)
    model = build(data.rig)
    made = []
    for r in range(len(data.runs)):
        made.append(_nearest(data, model, r))
        progress((r + 1) / len(data.runs))
    every = range(len(data.runs))
    return Comparison(rig, data.runs, tuple(made), tuple(record.window for record in data.records),
                      tuple(seconds_ahead(data, r) for r in every), tuple(not_closed(data, r) for r in every))


def _nearest(data: Dataset, model: Model, r: int) -> Simulation:
    record = data.records[r]
    tried = [make(data, model, r, data.own[r]) for make in (whole_run, settled_run)]

    def error(made: Simulation) -> float:
        away = record.measured - np.stack([getattr(made, c) for c in CHANNELS[: data.channels]])
        away = np.nan_to_num(away, nan=FAR, posinf=FAR, neginf=-FAR)
        return float(np.sum(record.share * (away / data.sigma[:, None]) ** 2))
    return min(tried, key=error)
