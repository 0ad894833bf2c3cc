"""Runs as an estimator sees them: what was read, how exactly, and what each run leaves unknown."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from station.errors import WorkError
from station.estimation.noise import QUANTISATION, noise_sigmas, rest_rows, rest_start, rounding_shares
from station.estimation.observer import Observer, observers
from station.model.simulate import build, simulate_model
from station.rig import PROFILE, Rig
from station.runs.run import RATES, Run, RunMetadata

SEGMENT = 1.0
"""Length of the stretches that are drawn again when data are resampled, s: longer than an arm's errors remember."""
SEGMENTS = 40
"""Most stretches in all runs together; they grow longer instead."""
CLOCK_BIAS = 2e-5
"""Least standard error of a clock's ratio: what receipt that is later at one end of a run than at the other feigns."""
FINDS = 0.1
"""Horizon (s) of the observer that finds the state of a rig in motion.  Of a shorter one the base follows the encoder
so stiffly that the beam's errors ring on as on a clamp; a longer one's base forgets late."""
WARM = 1.0
"""Seconds for that: what is wrong of a flexible arm's base and first mode is then below a hundredth."""
FIRST = 0.02
"""Seconds that tell whether a run begins in motion: too few for a command to move much."""
RIGIDITY = 0.03
"""Sigma of each harmonic of a beam's rigidity along its length, where the rig file says nothing: the cube of a
thickness that varies by a percent (of cold rolled strip several are allowed: EN 10140), or a sensor's cable along it.
"""
SEVERAL = 3
"""Runs from which on they can tell how much they differ."""
UNROUNDED = 0.3
"""Noise of an encoder, counts, from which on its rounding errors are independent from sample to sample (Widrow)."""


class Logs(NamedTuple):
    """What predictions need of several logs, one after another (N rows in all)."""

    first: np.ndarray
    """(runs + 1) int64: where each run's rows begin."""
    encoder: np.ndarray
    command: np.ndarray
    """(N) counts."""
    logged: np.ndarray
    """(N) bool."""
    warm: np.ndarray
    """(runs) int64: rows in which an observer finds the state."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """A nominal rig and its runs; c channels (encoder, accelerometer)."""

    rig: Rig
    runs: tuple[Run, ...]
    windows: tuple[np.ndarray, ...]
    """The rows of each run that count."""
    logged: tuple[np.ndarray, ...]
    """Per run (n): whether a row was logged; lost ones are simulated through and neither count nor correct."""
    measured: tuple[np.ndarray, ...]
    """Per run (c, n), counts."""
    share: tuple[np.ndarray, ...]
    """Per run (c, n): independent errors per sample."""
    noise: tuple[float, float]
    """Standard deviation before rounding of encoder and accelerometer, counts."""
    noise_rows: int
    start: np.ndarray
    """(runs) starting angle as read, rad."""
    offset: np.ndarray
    """(runs) the accelerometer's offset as read at rest, counts."""
    warm: tuple[int, ...]
    """Per run: rows in which an observer finds the state of a rig that is in motion when the log begins."""
    zero_group: tuple[int, ...]
    clock: tuple[float, float] | None
    segment: tuple[np.ndarray, ...]
    """Per run (n): the number of each row's stretch, counted over all runs."""
    segment_run: np.ndarray
    """(stretches) the run of each."""

    @property
    def channels(self) -> int:
        """1 without an accelerometer, else 2."""
        return self.share[0].shape[0]

    @property
    def has_accel(self) -> bool:
        """Whether the accelerometer is among the channels."""
        return self.channels == 2

    @cached_property
    def offset_error(self) -> np.ndarray:
        """(runs) standard error of the offset as read, counts: of a loop that acts from the start on, one reading's."""
        rows = [max(int(seen[: len(run) if warm else rest_rows(run)].sum()), 1)
                for run, seen, warm in zip(self.runs, self.logged, self.warm, strict=True)]
        return self.sigma[-1] / np.sqrt(rows) if self.has_accel else np.zeros(len(rows))

    @cached_property
    def start_error(self) -> np.ndarray:
        """(runs) standard error of the starting angle as read, counts, beside rounding's."""
        return np.array([self.noise[0] / math.sqrt(rest_start(run).stop) for run in self.runs])

    @property
    def own(self) -> np.ndarray:
        """(runs, 4) what each run has of its own, before a fit.

        Starting angle (rad), the accelerometer's offset (counts), and what the motor does more than the rig says: a
        share of the command, and a constant (counts of command).
        """
        none = np.zeros(len(self.runs))
        return np.stack([self.start, self.offset, none, none], axis=1)

    @cached_property
    def free(self) -> np.ndarray:
        """(c) the columns of ``own`` that a fit moves."""
        return np.flatnonzero([True, self.has_accel, *[len(self.runs) >= SEVERAL] * 2])

    @cached_property
    def logs(self) -> Logs:
        """All runs' rows."""
        return self._joined(range(len(self.runs)))

    @cached_property
    def log(self) -> tuple[Logs, ...]:
        """Every run's rows by themselves."""
        return tuple(self._joined([r]) for r in range(len(self.runs)))

    def _joined(self, some: Sequence[int]) -> Logs:
        """Some runs' rows, one after another."""
        first = np.concatenate([[0], np.cumsum([len(self.runs[r]) for r in some])]).astype(np.int64)
        return Logs(first, np.concatenate([self.measured[r][0] for r in some]),
                    np.concatenate([self.runs[r].command for r in some]).astype(float),
                    np.concatenate([self.logged[r] for r in some]),
                    np.array([self.warm[r] for r in some], dtype=np.int64))

    @cached_property
    def finder(self) -> Observer:
        """Finds the state of a rig that is in motion when a log begins."""
        return observers(self.rig, self.noise[0], (FINDS,))[0]

    @cached_property
    def rms_command(self) -> float:
        """Of all runs, counts."""
        return float(np.sqrt(np.mean(np.concatenate([run.command for run in self.runs]) ** 2)))

    @property
    def sigma(self) -> np.ndarray:
        """(c) standard deviation of a reading, rounding included, counts."""
        return np.sqrt(np.square(self.noise[: self.channels]) + QUANTISATION)

    @property
    def counts(self) -> np.ndarray:
        """(runs, c) independent errors of the sensors."""
        return np.array([share.sum(axis=1) for share in self.share])


def canonical_order(runs: Sequence[Run]) -> list[int]:
    """The order of runs by their content, so that nothing depends on the order in which files are named."""
    return sorted(range(len(runs)), key=lambda i: (content(runs[i]), runs[i].name))


def content(run: Run) -> str:
    """What a run holds, as a digest: of one log, however often it is given, the same."""
    parts = [run.t, run.reference, run.command, run.encoder, *([] if run.accel is None else [run.accel])]
    return hashlib.sha256(b"".join(np.ascontiguousarray(p, dtype=float).tobytes() for p in parts)).hexdigest()


def tests_of(runs: Sequence[Run]) -> list[Run]:
    """The runs, each log once: given twice, as for two parts of it, it is one test."""
    return list({content(run): run for run in runs}.values())


def dataset(rig: Rig, runs: Sequence[Run], windows: Sequence[slice] | None = None) -> Dataset:
    """Prepare runs, their gaps filled; ``windows``: the rows of each run that count (by default all that were logged).

    Of a log that is given twice, for two parts of it, noise and clock are read once.
    WorkError: a run's rate is not the rig's, or some runs hold the accelerometer and this one does not.
    """
    runs = [run.filled(rig.sample_rate) for run in runs]
    tests = tests_of(runs)
    has_accel = rig.accelerometer is not None and any(run.accel is not None for run in runs)
    for run in runs:
        if has_accel and run.accel is None:
            raise WorkError(f"{run.name}: no accelerometer column, but other runs have one; leave out one or the other")
        if abs(run.sample_rate / rig.sample_rate - 1.0) > RATES:
            raise WorkError(f"{run.name}: sampled at {run.sample_rate:.6g} Hz, the rig at {rig.sample_rate:.6g} Hz")
    logged = tuple(run.logged for run in runs)
    encoder, accel, rows = noise_sigmas(tests)
    meshed = rig.meshed()
    if rig.beam is not None:    # it need not be quite uniform
        meshed = meshed.model_copy(update={"uncertainty": {**dict.fromkeys(sorted(PROFILE), RIGIDITY),
                                                           **rig.uncertainty}})
    warm = tuple(_warm_rows(meshed, run, (encoder, accel) if has_accel else (encoder,)) for run in runs)
    kept = tuple(np.zeros_like(seen) for seen in logged)
    for row, seen, first, window in zip(kept, logged, warm, windows or [slice(None)] * len(runs), strict=True):
        row[window] = seen[window]
        row[:first] = False
    groups = list(dict.fromkeys(zero_ids := [r.metadata.zero_id or f"own {i}" for i, r in enumerate(runs)]))
    length = max(SEGMENT, sum(len(r.t) / r.sample_rate for r in runs) / SEGMENTS)
    parts = [max(round(len(r.t) / r.sample_rate / length), 1) for r in runs]
    segment = tuple(first + np.arange(len(r.t)) * count // len(r.t)
                    for r, count, first in zip(runs, parts, np.cumsum(parts) - parts, strict=True))
    return Dataset(
        rig=meshed, runs=tuple(runs), windows=kept, logged=logged,
        measured=tuple(np.stack([r.encoder, r.accel] if has_accel else [r.encoder]).astype(float) for r in runs),
        share=tuple(_shares(r, w, encoder)[: 1 + has_accel] for r, w in zip(runs, kept, strict=True)),
        noise=(encoder, accel), noise_rows=rows,
        start=np.array([float(np.mean(r.encoder[rest_start(r)])) * rig.angle_per_count for r in runs]),
        offset=np.array([float(np.mean(r.accel[: len(r) if w else max(rest_rows(r), 1)])) if has_accel else 0.0
                         for r, w in zip(runs, warm, strict=True)]),
        warm=warm, zero_group=tuple(groups.index(z) for z in zero_ids), clock=clock_evidence(tests), segment=segment,
        segment_run=np.repeat(np.arange(len(runs)), parts))


def first_seconds(data: Dataset, seconds: float) -> Dataset:
    """The same runs, of which each ends so long after its first command."""
    ends = [max(int(np.argmax(run.command != run.command[0])), warm) + math.ceil(seconds * run.sample_rate)
            for run, warm in zip(data.runs, data.warm, strict=True)]

    def cut(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        return tuple(np.ascontiguousarray(a[..., :end]) for a, end in zip(arrays, ends, strict=True))
    return replace(data, runs=tuple(run.slice(0, end) for run, end in zip(data.runs, ends, strict=True)),
                   windows=cut(data.windows), logged=cut(data.logged), measured=cut(data.measured),
                   share=cut(data.share), segment=cut(data.segment))


def _warm_rows(rig: Rig, run: Run, noise: Sequence[float]) -> int:
    """WARM in rows where a run begins in motion, else 0.

    It does where its first rows are not those of the nominal rig at rest, times a factor of 0 to 2 that fits them best,
    but for two counts, six sigma of noise and, of the accelerometer, a twentieth of what it reads in the whole run.
    """
    rows = max(math.ceil(FIRST * rig.sample_rate), 3)
    first = replace(run.slice(0, rows), metadata=RunMetadata(start="equilibrium"))
    made = simulate_model(build(rig), first, rounding=False, start_angle=float(run.encoder[0]) * rig.angle_per_count)
    moving = False
    for channel, sigma in zip(("encoder", "accel"), noise, strict=False):
        measured, could = getattr(run, channel), getattr(made, channel) - np.mean(getattr(made, channel))
        factor = min(max(float(could @ measured[:rows]) / max(float(could @ could), 1e-12), 0.0), 2.0)
        small = 0.05 * float(np.ptp(measured)) if channel == "accel" else 0.0
        moving |= float(np.ptp(measured[:rows] - factor * could)) > 2.0 + 6.0 * sigma + small
    return math.ceil(WARM * rig.sample_rate) if moving and len(run) > 2 * WARM * rig.sample_rate else 0


def _shares(run: Run, window: np.ndarray, noise: float) -> np.ndarray:
    """Independent errors per sample of encoder and accelerometer (2, n)."""
    ones = np.ones_like(run.encoder)
    return np.stack([ones if noise > UNROUNDED else rounding_shares(run.encoder), ones]) * window


def clock_evidence(runs: Sequence[Run]) -> tuple[float, float] | None:
    """True over nominal sample period and its standard error, by regression of host_time on device_time.

    None where no run has both; a simulated device's virtual time is no clock.  The error is taken from the scatter of
    the residuals and, since receipt is never early, is not allowed below CLOCK_BIAS, however many runs there are.
    """
    slopes, weights = [], []
    for run in runs:
        if run.host_time is None or run.device_time is None or getattr(run.metadata, "clock", None) == "virtual":
            continue
        x, y = run.device_time - run.device_time.mean(), run.host_time - run.host_time.mean()
        slope = float(x @ y / (x @ x))
        spread = float(np.std(y - slope * x)) / math.sqrt(float(x @ x))
        slopes.append(slope)
        weights.append(max(spread, CLOCK_BIAS) ** -2)
    if not slopes:
        return None
    return float(np.average(slopes, weights=weights)), max(float(np.sum(weights)) ** -0.5, CLOCK_BIAS)
