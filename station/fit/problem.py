"""What a fit compares: residuals of runs in time and of measured responses in frequency, and their derivatives.

Unknowns x are first the constants in the coordinates of the rig file's uncertainty: log(value/nominal) = root x with
root root' the stated covariance, so that each is a standard normal beforehand.  Then follow, for each run, a starting
angle and an accelerometer offset (counts).  Residuals are divided by the reading's noise, so that a rig that is right
gives values of size 1.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from station.errors import WorkError
from station.estimation.noise import QUANTISATION, noise_sigmas
from station.model.frequency import finite_element_response, measured_response
from station.model.simulate import Model, build, simulate_model
from station.rig import Rig
from station.runs.run import Run

STEP = 3e-5
"""Of the differences by a constant, in stated deviations."""
ANGLE_STEP = 0.1
"""Counts; the model is linear in the starting angle but for the limit."""
TRUNCATION = 1e-9
"""Modes left out of the simulations of a fit may add so many counts: too little to disturb a difference."""
COHERENT = 0.8
"""Least coherence of a frequency that is used."""
RESPONSE_FLOOR = 0.02
"""Least relative error of a measured response: what leakage and a sweep's passing leave."""
FAR = 1e6
"""Residual in place of a number that a simulation could not give."""


@dataclass(frozen=True)
class Spectrum:
    """A run's measured response at the frequencies that are used: (n) each, errors relative."""

    frequency: np.ndarray
    value: np.ndarray
    error: np.ndarray
    sensor: str


class Problem:
    """Runs, what of them is compared, and the constants that are sought."""

    def __init__(self, rig: Rig, runs: Sequence[Run], paths: list[str], domain: str) -> None:
        self.rig, self.paths = rig.meshed(), paths
        self.root = np.linalg.cholesky(rig.log_covariance(paths))
        runs = [run.filled(rig.sample_rate) for run in runs]
        self.runs = runs if domain in ("time", "both") else []
        sigma = noise_sigmas(runs)
        self.scale = [1.0 / np.sqrt(s**2 + QUANTISATION) for s in sigma]
        self.has_accel = [run.accel is not None and rig.accelerometer is not None for run in self.runs]
        self.spectra = [s for run in runs for s in _spectra(rig, run)] if domain in ("frequency", "both") else []
        if not self.runs and not self.spectra:
            raise WorkError("no run is long and rich enough for a fit in the frequency domain (coherence "
                            f"above {COHERENT:g} where?); fit in the time domain")
        self._pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1)

    def close(self) -> None:
        """Let the threads go."""
        self._pool.shutdown()

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.paths) + 2 * len(self.runs)

    @property
    def samples(self) -> int:
        """Number of residuals."""
        times = sum(len(run.t) * (2 if accel else 1) for run, accel in zip(self.runs, self.has_accel, strict=True))
        return times + 2 * sum(len(s.frequency) for s in self.spectra)

    @property
    def blocks(self) -> list[slice]:
        """The residuals of each run and sensor in time, in order; those of the spectra follow."""
        found, at = [], 0
        for run, accel in zip(self.runs, self.has_accel, strict=True):
            for _ in range(2 if accel else 1):
                found.append(slice(at, at + len(run.t)))
                at += len(run.t)
        return found

    def rig_at(self, x: np.ndarray) -> Rig:
        """The rig of a point."""
        nominal, logs = self.rig.constants(), self.root @ x[:len(self.paths)]
        return self.rig.with_constants({p: nominal[p] * np.exp(v) for p, v in zip(self.paths, logs, strict=True)})

    def start(self) -> np.ndarray:
        """The nominal rig, the angles and offsets that the first rows show."""
        x = np.zeros(self.size)
        for r, (run, accel) in enumerate(zip(self.runs, self.has_accel, strict=True)):
            at = len(self.paths) + 2 * r
            x[at] = run.encoder[0]
            x[at + 1] = float(np.median(run.accel[:10])) if accel else 0.0
        return x

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Measured less simulated over the noise, all runs and spectra after each other."""
        rig = self.rig_at(x)
        model = build(rig, truncation=TRUNCATION) if self.runs else None
        parts = [self._time(model, r, x) for r in range(len(self.runs))]
        parts += [_response_residuals(rig, spectrum) for spectrum in self.spectra]
        out = np.concatenate(parts)
        return np.where(np.isfinite(out), np.clip(out, -FAR, FAR), FAR)

    def jacobian(self, x: np.ndarray, base: np.ndarray | None = None) -> np.ndarray:
        """Derivatives (samples, size) by differences, the simulations spread over the processor's cores.

        A constant moves everything; an angle only its run; an offset is known beforehand.  Differences are central,
        so that a direction that the data do not see stays unseen; forward ones from the residuals ``base``, where
        given, cost half.
        """
        count, model = len(self.paths), build(self.rig_at(x), truncation=TRUNCATION) if self.runs else None
        out = np.zeros((self.samples, x.size))

        def constant(k: int) -> None:
            ahead, behind = x.copy(), x.copy()
            ahead[k] += STEP
            behind[k] -= STEP
            back = self.residuals(behind) if base is None else base
            out[:, k] = (self.residuals(ahead) - back) / (2.0 * STEP if base is None else STEP)

        def angle(r: int) -> None:
            moved, at, rows = x.copy(), count + 2 * r, self._rows(r)
            moved[at] += ANGLE_STEP
            out[rows, at] = (self._time(model, r, moved) - self._time(model, r, x)) / ANGLE_STEP
            if self.has_accel[r]:
                out[rows.start + len(self.runs[r].t):rows.stop, at + 1] = -self.scale[1] * self.runs[r].logged

        tasks = [(constant, k) for k in range(count)] + [(angle, r) for r in range(len(self.runs))]
        list(self._pool.map(lambda task: task[0](task[1]), tasks))
        return out

    def rounding(self, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """What rounding to whole counts does to the readings, over the noise, for angles that began somewhere else.

        Inside a loop it does more than blur a reading: the compensator answers it.
        """
        out, count = np.zeros(self.samples), len(self.paths)
        model = build(self.rig_at(x), truncation=TRUNCATION) if self.runs else None
        moved = x.copy()
        moved[count::2] += rng.uniform(-0.5, 0.5, len(self.runs))
        for r in range(len(self.runs)):
            out[self._rows(r)] = self._time(model, r, moved) - self._time(model, r, moved, rounding=True)
        return out

    def _rows(self, r: int) -> slice:
        sizes = [len(run.t) * (2 if accel else 1) for run, accel in zip(self.runs, self.has_accel, strict=True)]
        return slice(sum(sizes[:r]), sum(sizes[:r + 1]))

    def _time(self, model: Model, r: int, x: np.ndarray, rounding: bool = False) -> np.ndarray:
        run, at = self.runs[r], len(self.paths) + 2 * r
        made = simulate_model(model, run, rounding=rounding, start_angle=x[at] * self.rig.angle_per_count,
                              accel_offset=x[at + 1])
        encoder = (run.encoder - made.encoder) * self.scale[0] * run.logged
        if not self.has_accel[r]:
            return encoder
        return np.concatenate([encoder, (run.accel - made.accel) * self.scale[1] * run.logged])


def _spectra(rig: Rig, run: Run) -> list[Spectrum]:
    """Coherent parts of a run's responses; none where it is too short or never moves."""
    try:
        found = measured_response(run)
    except WorkError:
        return []
    segments = max(1.0, len(run.t) / (run.sample_rate / found.frequency[0]))
    out = []
    for sensor in ("encoder", "accel"):
        coherence = getattr(found, f"{sensor}_coherence")
        if coherence is None or (sensor == "accel" and rig.accelerometer is None):
            continue
        kept = (coherence > COHERENT) & (found.frequency < 0.45 * run.sample_rate)
        if kept.sum() >= 5:
            # Bendat and Piersol, Random Data, ch. 9: the relative standard error of |H1| and of its phase.
            error = np.sqrt((1.0 - coherence[kept]) / (2.0 * segments * coherence[kept]) + RESPONSE_FLOOR**2)
            out.append(Spectrum(found.frequency[kept], getattr(found, sensor)[kept], error, sensor))
    return out


def _response_residuals(rig: Rig, spectrum: Spectrum) -> np.ndarray:
    """Logarithm of magnitude and phase, measured over model, in units of their errors."""
    model = getattr(finite_element_response(rig, spectrum.frequency), spectrum.sensor)
    ratio = np.log(spectrum.value / model)
    return np.concatenate([ratio.real, ratio.imag]) / np.tile(spectrum.error, 2)
