"""Measured frequency responses as further data: the logarithm of a run's response against the rig's.

Of every run and channel two blocks: magnitude, ln |H|, and phase, rad.  Their frequencies are spread evenly over the
run's rows, so that a stretch of time, which is drawn again or counts by itself, is here a band of frequencies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from station.errors import WorkError
from station.estimation.dataset import Dataset
from station.estimation.likelihood import blocks_independent
from station.estimation.parameters import Parameters
from station.estimation.prediction import Predictor
from station.model.frequency import finite_element_response, measured_response
from station.model.simulate import Model
from station.runs.run import Run

COHERENT = 0.8
"""Least coherence of a frequency that is used."""
FEWEST = 5
"""Least number of such frequencies in a response that is used."""
PASSED = 0.45
"""Share of the logged rows' rate up to which a response is used."""
FLOOR = 0.02
"""Least relative error of a measured response: what leakage and a sweep's passing leave."""

ALIKE = 18.0 / 35.0
"""Independent errors per frequency: neighbours share Hann's window (r = -2/3, 1/6), and n / sum r^2 are independent."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The coherent part of a run's response from the command to one sensor."""

    sensor: str
    frequency: np.ndarray
    """(m) Hz."""
    value: np.ndarray
    """(m) counts per count."""
    error: np.ndarray
    """(m) relative."""
    rows: np.ndarray
    """(m) where in the run's rows the frequencies stand."""


def with_responses(predictor: Predictor, alone: bool) -> ResponsePredictor:
    """The same with every run's responses, which count ``alone`` or beside the predictions in time.

    WorkError: alone, and no run is long and rich enough.
    """
    data = predictor.data
    found = [spectra(run, data.channels) for run in data.runs]
    if alone and not any(spectrum for row in found for spectrum in row):
        raise WorkError("no run is long and rich enough for a fit in the frequency domain (coherence above "
                        f"{COHERENT:g} at {FEWEST} frequencies); fit in the time domain")
    return ResponsePredictor(data, () if alone else predictor.observers, predictor.pool, predictor.accuracy,
                             predictor.final, spectra=found)


def spectra(run: Run, channels: int) -> list[Spectrum | None]:
    """Of encoder and accelerometer (``channels`` 1 or 2); None where a run is too short, too poor or never moves."""
    try:
        found = measured_response(run)
    except WorkError:
        return [None] * channels
    segments = max(1.0, len(run.t) / (run.sample_rate / found.frequency[0]))

    def coherent(sensor: str) -> Spectrum | None:
        value, coherence = getattr(found, sensor), getattr(found, f"{sensor}_coherence")
        if value is None or coherence is None:
            return None
        kept = (coherence > COHERENT) & (found.frequency < PASSED * run.sample_rate * np.mean(run.logged))
        if kept.sum() < FEWEST:
            return None
        # Bendat and Piersol, Random Data, ch. 9: the relative standard error of |H1| and of its phase.
        error = np.sqrt((1.0 - coherence[kept]) / (2.0 * segments * coherence[kept]) + FLOOR**2)
        rows = np.linspace(0, len(run.t) - 1, int(kept.sum())).round().astype(int)
        return Spectrum(sensor, found.frequency[kept], value[kept], error, rows)

    return [coherent(sensor) for sensor in ("encoder", "accel")[:channels]]


@dataclass(frozen=True, eq=False)
class ResponsePredictor(Predictor):
    """Predictions in time, none without observers, and below them those of every channel's response."""

    spectra: Sequence[Sequence[Spectrum | None]] = ()
    """Per run and channel."""

    def on(self, data: Dataset) -> Predictor:
        """Predictions in time alone: responses are those of whole runs."""
        return Predictor(data, self.observers, self.pool, self.accuracy)

    def measured(self, run: int) -> np.ndarray:
        """(b, n) readings, counts, and logarithms of responses."""
        return self._joined(run, super().measured(run), lambda s: np.log(s.value))

    def share(self, run: int) -> np.ndarray:
        """(b, n) independent errors per sample."""
        return self._joined(run, super().share(run), lambda s: np.full(s.rows.size, 1.0 + 1.0j))

    def scale(self, run: int) -> np.ndarray:
        """(b, n) one over the errors' size."""
        return self._joined(run, super().scale(run), lambda s: (1.0 + 1.0j) / s.error)

    @cached_property
    def power(self) -> np.ndarray:
        """(runs, b) what errors are in proportion to: a response's logarithm is in error by as much in all runs."""
        times = super().power
        return np.hstack([times, np.ones((len(times), 2 * self.data.channels))])

    def independent(self, squares: np.ndarray, residuals: list[np.ndarray]) -> np.ndarray:
        """(runs, b) N of every block."""
        times = len(self.channel)
        read = blocks_independent(squares[:, :times], self.counts[:, :times], self.power[:, :times],
                                  [e[:times] for e in residuals])
        return np.hstack([read, ALIKE * self.counts[:, times:]])

    def some(self, model: Model, space: Parameters, x: np.ndarray, runs: Sequence[int], own: np.ndarray,
             ) -> list[np.ndarray]:
        """Predictions (b, n) of one run, or of all: readings, counts, and logarithms of responses, phases nearest the
        measured."""
        def response(s: Spectrum) -> np.ndarray:
            simulated = getattr(finite_element_response(model.rig, s.frequency), s.sensor)
            return np.log(s.value) - np.log(s.value / simulated)
        return [self._joined(r, times, response) for r, times in
                zip(runs, super().some(model, space, x, runs, own), strict=True)]

    def _joined(self, run: int, times: np.ndarray, of: Callable[[Spectrum], np.ndarray]) -> np.ndarray:
        """Blocks in time (b, n) and below them the real and imaginary part of what ``of`` says of every response."""
        blocks = np.zeros((2 * self.data.channels, times.shape[1]))
        for c, spectrum in enumerate(self.spectra[run]):
            if spectrum is not None:
                found = of(spectrum)
                blocks[2 * c, spectrum.rows], blocks[2 * c + 1, spectrum.rows] = found.real, found.imag
        return np.vstack([times, blocks])
