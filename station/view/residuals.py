"""The residuals of the last section of a report: how far each sample lies from its prediction one sample ahead.

They are the innovations of the observer of the quick horizon (station.estimation.observer), with the logged command:
no controller enters, so that in a closed loop, too, an earlier command that still shows in them is physics that the rig
lacks (the direct method, Ljung 1999, section 13.4).  Residuals of whole closed loops would not do: noise goes round the
loop and comes back coloured though the rig be right.  Of an open integrator's whole run the drift would hide all else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from station.diagnose.result import DiagnosisResult
from station.estimation.dataset import Dataset, dataset
from station.estimation.observer import Observer, observers
from station.estimation.prediction import predict_run
from station.model.simulate import Model, build
from station.rig import Rig
from station.runs.run import Run
from station.view.remaining import Correlation, Whiteness, command_correlation, whiteness
from station.view.wording import CHANNELS

LIKE_NOISE = 1.1
"""Times the standard deviation of a reading up to which a residual is no larger than noise: a tenth more."""


@dataclass(frozen=True)
class Residual:
    """One channel of one run, measured less predicted one sample ahead, counts, rows that were not logged left out."""

    number: int
    """The run's place in the report, from 1."""
    channel: str
    before: np.ndarray
    """(n) by the rig file as it is."""
    after: np.ndarray
    """(n) by the extended rig, or the re-fitted one where nothing was added."""
    command: np.ndarray
    """(n) counts, in force from each row on."""
    noise: float
    """Standard deviation of a reading, rounding included, counts."""
    horizon: float
    """Seconds after which the observer has forgotten an error."""

    @property
    def scatter(self) -> float:
        """Standard deviation of what remains, counts."""
        return float(self.after.std())

    @property
    def larger(self) -> bool:
        """Whether what remains is larger than noise."""
        return self.scatter > LIKE_NOISE * self.noise

    @cached_property
    def whiteness(self) -> Whiteness:
        """Of what remains."""
        return whiteness(self.after)

    @cached_property
    def crossing(self) -> Correlation:
        """Of what remains with the command."""
        return command_correlation(self.after, self.command)


def residuals(result: DiagnosisResult) -> list[Residual]:
    """Of every run that can be predicted, angle first, in the report's order.

    Left out: the second half of a run that is alone; predictions that run away.
    """
    kept = _runs(result)
    if not kept:
        return []
    data = dataset(result.rig, [run for _, run in kept])
    observer = observers(data.rig, data.noise[0])[0]
    models = [build(data.rig), build(_same_mesh(result.extended_rig, data.rig))]
    found = []
    for r, (number, _) in enumerate(kept):
        errors = [_errors(data, model, observer, r) for model in models]
        rows = data.records[r].window
        if not all(np.all(np.isfinite(e)) for e in errors):
            continue
        for c, channel in enumerate(list(CHANNELS)[: data.channels]):
            found.append(Residual(number, channel, errors[0][c, rows], errors[1][c, rows],
                                  data.runs[r].command[rows], float(data.sigma[c]), observer.horizon))
    return found


def _runs(result: DiagnosisResult) -> Sequence[tuple[int, Run]]:
    runs = [c.zeroed(result.rig.angle_per_count) for c in result.comparisons]
    halves = [run.name.rpartition(" (")[2] for run in runs] == ["first half)", "second half)"]
    return list(enumerate(runs[:1] if halves else runs, start=1))


def _same_mesh(rig: Rig, like: Rig) -> Rig:
    """The rig with as many elements as another: an observer is made for one mesh."""
    return rig if rig.beam is None or like.beam is None else rig.with_elements(like.beam.elements)


def _errors(data: Dataset, model: Model, observer: Observer, r: int) -> np.ndarray:
    """(c, n) measured less predicted, counts."""
    return data.records[r].measured - predict_run(data, model, (observer,), r, data.own[r])[0][0, : data.channels]
