"""One run as an estimator sees it: which of its rows count, and how much each of them tells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from station.estimation.noise import UNROUNDED, rest_rows, rest_start, rounding_shares
from station.model.simulate import Simulation, build, simulate_model
from station.rig import Rig
from station.runs.columns import SENSORS
from station.runs.run import Run, RunMetadata

WARM, FOUND = 1.0, 0.01
"""Seconds in which an observer finds the state of a rig in motion, and a share: of what is wrong at first of a flexible
arm's base and first mode less than that is left then."""
PUSHED = 0.01
"""Largest constant that a motor does of itself, as a share of the amplifier's limit (an offset of its input): it turns
a rig that is at rest, and a fine encoder shows that at once."""
FIRST = 0.02
"""Seconds that tell whether a run begins in motion: too few for a command to move much."""
FIRST_COUNTS, FIRST_SIGMAS, FIRST_SHARE = 2.0, 6.0, 0.05
"""By how much these may differ from a rig at rest: counts (two readings, each rounded either way), sigmas of the noise,
and, of the accelerometer, a share of what it reads in the whole run."""


class Logs(NamedTuple):
    """What predictions need of several logs, one after another (N rows in all)."""

    first: np.ndarray
    """(runs + 1) int64: where each run's rows begin."""
    encoder: np.ndarray
    command: np.ndarray
    """(N) counts."""
    read: np.ndarray
    """(N) bool: whether what an observer misses there corrects it."""
    finding: np.ndarray
    """(N) bool: as ``Record`` has it."""


@dataclass(frozen=True, eq=False)
class Record:
    """One run as an estimator sees it: n rows, c channels (encoder, accelerometer)."""

    run: Run
    """Its gaps filled: rows that were not logged do not count, and nothing corrects a prediction there; but over a gap
    of which nobody knows the commands an observer follows the straight line between what was read."""
    window: np.ndarray
    """(n) whether a row counts."""
    measured: np.ndarray
    """(c, n), counts."""
    share: np.ndarray
    """(c, n) independent errors per sample."""
    start: float
    """Starting angle as read, rad."""
    offset: float
    """The accelerometer's as read at rest, counts."""
    finding: np.ndarray
    """(n) whether an observer finds the rig's state: where it is in motion when the log begins, and over a gap of which
    nobody knows the commands and after it."""
    zero_group: int
    """Number of the encoder's zero: runs of one share it."""
    segment: np.ndarray
    """(n) the number of each row's stretch, counted over all runs."""

    @property
    def released(self) -> bool:
        """Whether it begins at rest, held where it was read."""
        return self.run.metadata.start != "equilibrium" and not self.in_motion

    @property
    def in_motion(self) -> bool:
        """Whether the log begins in motion."""
        return bool(self.finding[0])


def record_of(rig: Rig, run: Run, window: slice, noise: Sequence[float], zero_group: int,
              segment: np.ndarray) -> Record:
    """One run, its gaps filled, whose rows in a window count; ``noise`` of each channel, counts."""
    channels, finding, kept = len(noise), _finding(rig, run, noise), np.zeros(len(run), dtype=bool)
    kept[window] = (run.logged & ~finding)[window]
    readings = [run.encoder, run.accel][:channels]
    rest = len(run) if finding[0] else max(rest_rows(run), 1)
    return Record(
        run=run, window=kept, measured=np.stack(readings).astype(float),
        share=_shares(run, kept, noise),
        start=float(np.mean(run.encoder[rest_start(run)])) * rig.angle_per_count,
        offset=float(np.mean(readings[1][:rest])) if channels > 1 else 0.0, finding=finding,
        zero_group=zero_group, segment=segment)


def joined(records: Sequence[Record]) -> Logs:
    """Rows of records, one after another."""
    first = np.concatenate([[0], np.cumsum([len(one.run) for one in records])]).astype(np.int64)
    return Logs(first, np.concatenate([one.measured[0] for one in records]),
                np.concatenate([one.run.command for one in records]).astype(float),
                np.concatenate([one.run.logged | one.run.blank for one in records]),
                np.concatenate([one.finding for one in records]))


def _finding(rig: Rig, run: Run, noise: Sequence[float]) -> np.ndarray:
    """(n) rows of a run, its gaps filled, that do not count because its state is being found: WARM where it begins in
    motion, a beam that rings by a share of what it ever does until FOUND is left, and a gap of which nobody knows the
    commands with WARM after it."""
    rows, finding = math.ceil(WARM * rig.sample_rate), np.zeros(len(run), dtype=bool)
    moving = _moving(rig, run, noise)
    finding[: math.ceil(rows * (1.0 - math.log(max(moving, FOUND)) / math.log(FOUND)))] = True
    for end in np.flatnonzero(np.diff(run.blank.astype(int)) < 0) + 1:
        finding[end: end + rows] = True
    return finding | run.blank


def _moving(rig: Rig, run: Run, noise: Sequence[float]) -> float:
    """With how much of its motion a run of more than twice WARM begins: 1 where the encoder shows some, a share of all
    that the accelerometer reads where that alone does; 0 where it begins at rest.

    It does where its first rows are those of the nominal rig at rest: times a factor of 0 to 2, beside what a constant
    of PUSHED of the amplifier's limit either way does, that fit them best.
    """
    if len(run) <= 2 * WARM * rig.sample_rate:
        return 0.0
    rows, model = max(math.ceil(FIRST * rig.sample_rate), 3), build(rig)
    first = replace(run.slice(0, rows), metadata=RunMetadata(start="equilibrium"))

    def made(more: float) -> Simulation:
        return simulate_model(model, first, rounding=False, more=(0.0, more),
                              start_angle=float(run.encoder[0]) * rig.angle_per_count)

    asked, pushed, moving = made(0.0), made(PUSHED * rig.amplifier.limit), 0.0
    for channel, sigma in zip(SENSORS, noise, strict=False):
        measured, could, further = (getattr(one, channel)[:rows] for one in (run, asked, pushed))
        columns = np.stack([could, further - could], axis=1)
        columns = columns - columns.mean(axis=0)
        fits = lsq_linear(columns, measured - measured.mean(), ([0.0, -1.0], [2.0, 1.0])).x
        beyond, most = float(np.ptp(measured - columns @ fits)), float(np.ptp(getattr(run, channel)))
        small = FIRST_COUNTS * run.step(channel) + FIRST_SIGMAS * sigma + FIRST_SHARE * most * (channel == "accel")
        if beyond > small:
            moving = max(moving, beyond / most if channel == "accel" else 1.0)
    return min(moving, 1.0)


def _shares(run: Run, window: np.ndarray, noise: Sequence[float]) -> np.ndarray:
    """Independent errors per sample of each channel (c, n)."""
    readings = [(read, run.step(channel)) for channel in SENSORS if (read := getattr(run, channel)) is not None]
    return np.stack([np.ones_like(read) if own > UNROUNDED * step else rounding_shares(read / step)
                     for (read, step), own in zip(readings, noise, strict=False)]) * window
