"""Runs as an estimator sees them: what was read, how exactly, and what each run leaves unknown."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from station.errors import WorkError
from station.estimation.noise import (
    QUANTISATION,
    accel_step,
    noise_of,
    rest_rows,
    rest_start,
    rounding_shares,
    run_by_run,
)
from station.estimation.observer import Observer, observers
from station.model.effects import USUAL_SPEED
from station.model.simulate import Simulation, build, simulate_model
from station.rig import PROFILE, Rig
from station.runs.columns import SENSORS, place
from station.runs.rollover import rollover, rollover_fault
from station.runs.run import Run, RunMetadata
from station.runs.ticks import CLOCKS

SEGMENT = 1.0
"""Length of the stretches that are drawn again when data are resampled, s: longer than an arm's errors remember."""
SEGMENTS = 40
"""Most stretches in all runs together, one in each at least; they grow longer instead."""
FINDS = 0.1
"""Horizon (s) of the observer that finds the state of a rig in motion.  Of a shorter one the base follows the encoder
so stiffly that the beam's errors ring on as on a clamp; a longer one's base forgets late."""
WARM, FOUND = 1.0, 0.01
"""Seconds for that: what is wrong of a flexible arm's base and first mode is then below a hundredth of what it was."""
PUSHED = 0.01
"""Largest constant that a motor does of itself, as a share of the amplifier's limit (an offset of its input): it turns
a rig that is at rest, and a fine encoder shows that at once."""
FIRST = 0.02
"""Seconds that tell whether a run begins in motion: too few for a command to move much."""
MOTION = 256
"""Angles and speeds, and torques of a joint, that tell how runs move: of the slope of a law that levels off, two
thousandths beside all rows."""
FIRST_COUNTS, FIRST_SIGMAS, FIRST_SHARE = 2.0, 6.0, 0.05
"""By how much these may differ from a rig at rest: counts (two readings, each rounded either way), sigmas of the noise,
and, of the accelerometer, a share of what it reads in the whole run."""
RIGIDITY = 0.03
"""Sigma of each harmonic of a beam's rigidity along its length, where the rig file says nothing: the cube of a
thickness that varies by a percent (of cold rolled strip several are allowed: EN 10140), or a sensor's cable along it.
"""
UNROUNDED = 0.3
"""Noise of a sensor, steps of its readings, from which on rounding errors are independent from sample to sample
(Widrow)."""


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


@dataclass(frozen=True, eq=False)
class Dataset:
    """A nominal rig and the records of its runs; c channels (encoder, accelerometer)."""

    rig: Rig
    records: tuple[Record, ...]
    noise: tuple[float, float]
    """Standard deviation before rounding of encoder and accelerometer, counts."""
    noise_freedoms: tuple[float, float]
    """Degrees of freedom of their estimates."""
    accel_noise: np.ndarray
    """(2, runs) variance of the accelerometer's readings in each run over that in all, and its degrees of freedom."""
    clock: tuple[float, float] | None
    segment_run: np.ndarray
    """(stretches) the run of each."""
    carried: dict[str, np.ndarray]
    """By joint (drive, clamp), torques (MOTION), N m, that it carries in the runs by the nominal rig without effects,
    at equal shares of the sum of squared ones; none where it carries none."""

    @cached_property
    def segment_counts(self) -> np.ndarray:
        """(stretches) whether a row of each counts."""
        held = np.zeros(len(self.segment_run), dtype=bool)
        for record in self.records:
            held[record.segment[record.window]] = True
        return held

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """Their gaps filled."""
        return tuple(record.run for record in self.records)

    @cached_property
    def zero_groups(self) -> tuple[int, ...]:
        """(runs) numbers of the encoder's zeros."""
        return tuple(record.zero_group for record in self.records)

    @cached_property
    def start(self) -> np.ndarray:
        """(runs) starting angle as read, rad."""
        return np.array([record.start for record in self.records])

    @cached_property
    def offset(self) -> np.ndarray:
        """(runs) the accelerometer's offset as read at rest, counts."""
        return np.array([record.offset for record in self.records])

    @property
    def channels(self) -> int:
        """1 without an accelerometer, else 2."""
        return self.records[0].share.shape[0]

    @property
    def has_accel(self) -> bool:
        """Whether the accelerometer is among the channels."""
        return self.channels == 2

    @cached_property
    def offset_error(self) -> np.ndarray:
        """(runs) standard error of the offset as read, counts: of a loop that acts from the start on, one reading's."""
        rows = [max(int(r.run.logged[: None if r.in_motion else rest_rows(r.run)].sum()), 1) for r in self.records]
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
        return np.flatnonzero([True, self.has_accel, *[len(self.runs) > 1] * 2])

    @cached_property
    def logs(self) -> Logs:
        """All runs' rows."""
        return _joined(self.records)

    @cached_property
    def log(self) -> tuple[Logs, ...]:
        """Every run's rows by themselves."""
        return tuple(_joined([record]) for record in self.records)

    @cached_property
    def finder(self) -> Observer:
        """Finds the state of a rig that is in motion when a log begins, or goes on after a gap."""
        return observers(self.rig, self.noise[0], (FINDS,))[0]

    @cached_property
    def rms_command(self) -> float:
        """Of all runs, counts."""
        return float(np.sqrt(np.mean(np.concatenate([run.command for run in self.runs]) ** 2)))

    @cached_property
    def _first(self) -> tuple[int, np.ndarray]:
        """The rows of FIRST seconds, and counts by which the encoder moves from each row of all runs over them."""
        rows = max(math.ceil(FIRST * self.rig.sample_rate), 1)
        return rows, np.concatenate([run.encoder[rows:] - run.encoder[:-rows] for run in self.runs])

    @cached_property
    def speed(self) -> float:
        """Root mean square of all runs', rad/s, over FIRST seconds each, what noise adds taken off; where nothing moves
        beyond it USUAL_SPEED."""
        rows, moved = self._first
        square = (float(np.mean(moved**2)) if moved.size else 0.0) - 2.0 * self.sigma[0] ** 2
        return math.sqrt(square) / rows * self.rig.sample_rate * self.rig.angle_per_count if square > 0 else USUAL_SPEED

    @cached_property
    def motion(self) -> np.ndarray:
        """(MOTION, 2) angles (rad, of the encoder's count) and speeds (rad/s, over FIRST seconds) of all runs, each at
        an equal share of the sum of squared speeds: where a run moves."""
        rows, moved = self._first
        at = _evenly(moved)
        middle = np.concatenate([0.5 * (run.encoder[rows:] + run.encoder[:-rows]) for run in self.runs])
        return np.stack([middle[at], moved[at] / rows * self.rig.sample_rate], axis=1) * self.rig.angle_per_count

    @cached_property
    def sigma(self) -> np.ndarray:
        """(c) standard deviation of a reading, rounding included, counts."""
        steps = np.array([1.0, accel_step(self.runs)])
        return np.sqrt(np.square(self.noise[: self.channels]) + QUANTISATION * steps[: self.channels] ** 2)


def _evenly(values: np.ndarray) -> np.ndarray:
    """Indices (MOTION) of values at equal shares of the sum of their squares; none of values that are all 0."""
    share = np.cumsum(values**2)
    return np.searchsorted(share, (np.arange(MOTION) + 0.5) / MOTION * share[-1]) if values.any() else np.zeros(0, int)


def _carried(rig: Rig, runs: Sequence[Run]) -> dict[str, np.ndarray]:
    """As ``Dataset`` has it."""
    model = build(rig.with_effects([]))
    found: dict[str, list[np.ndarray]] = {at: [] for at in ("drive", "clamp") if getattr(rig, at) is not None}
    for run in runs if found else []:
        moved = simulate_model(model, replace(run, metadata=RunMetadata()), states=True).states
        assert moved is not None
        for at, torques in found.items():
            torques.append(getattr(rig, at).stiffness * (moved @ model.assembly.rotation(at)))
    joined = {at: np.concatenate(torques) for at, torques in found.items()}
    return {at: torque[_evenly(torque)] for at, torque in joined.items() if torque.any()}


def _joined(records: Sequence[Record]) -> Logs:
    """Rows of records, one after another."""
    first = np.concatenate([[0], np.cumsum([len(one.run) for one in records])]).astype(np.int64)
    return Logs(first, np.concatenate([one.measured[0] for one in records]),
                np.concatenate([one.run.command for one in records]).astype(float),
                np.concatenate([one.run.logged | one.run.blank for one in records]),
                np.concatenate([one.finding for one in records]))


def by_content(runs: Sequence[Run]) -> list[Run]:
    """The runs in the order of their content, so that nothing depends on the order in which files are named."""
    return sorted(runs, key=lambda run: (content(run), run.name))


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
    WorkError: a run's rate is not the rig's, its encoder rolls over, or some runs hold the accelerometer and this one
    does not.
    """
    for run in runs:
        if rolled := rollover(run.encoder, rig.encoder.counts_per_revolution):
            # By which count the loop went only its maker knows.
            raise WorkError(f"{run.name}: {rollover_fault(run.encoder, rolled, place(rolled[0]))}")
    runs = [run.filled(rig.sample_rate) for run in runs]
    tests = tests_of(runs)
    has_accel = rig.accelerometer is not None and any(run.accel is not None for run in runs)
    for run in runs:
        if has_accel and run.accel is None:
            raise WorkError(f"{run.name}: no accelerometer column, but other runs have one; leave out one or the other")
        if fault := run.rate_fault(rig.sample_rate):
            raise WorkError(f"{run.name}: {fault}")
    noise, digests = noise_of(tests), [content(run) for run in runs]
    of_test = dict(zip(dict.fromkeys(digests), np.transpose(run_by_run(tests)), strict=True))
    accel_noise = np.transpose([of_test[digest] for digest in digests])
    meshed = rig.meshed()
    if rig.beam is not None:    # it need not be quite uniform
        meshed = meshed.model_copy(update={"uncertainty": {**dict.fromkeys(sorted(PROFILE), RIGIDITY),
                                                           **rig.uncertainty}})
    zero_ids = [run.metadata.zero_id or digest for run, digest in zip(runs, digests, strict=True)]
    groups = list(dict.fromkeys(zero_ids))
    length = max(SEGMENT, sum(len(r.t) / r.sample_rate for r in runs) / SEGMENTS)
    parts = [max(round(len(r.t) / r.sample_rate / length), 1) for r in runs]
    records = tuple(
        _record(meshed, run, window, noise.sigmas[: 1 + has_accel], groups.index(zero),
                first + np.arange(len(run.t)) * count // len(run.t))
        for run, window, zero, first, count
        in zip(runs, windows or [slice(None)] * len(runs), zero_ids, np.cumsum(parts) - parts, parts, strict=True))
    return Dataset(meshed, records, noise=noise.sigmas, noise_freedoms=noise.freedoms, accel_noise=accel_noise,
                   clock=clock_evidence(tests), segment_run=np.repeat(np.arange(len(runs)), parts),
                   carried=_carried(meshed, tests))


def _record(rig: Rig, run: Run, window: slice, noise: Sequence[float], zero_group: int, segment: np.ndarray) -> Record:
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


def first_seconds(data: Dataset, seconds: float) -> Dataset:
    """The same runs, of which each ends so long after its first command."""
    def cut(one: Record) -> Record:
        run = one.run
        found = int(np.argmin(one.finding))     # the first row of a known state
        end = max(int(np.argmax(run.command != run.command[0])), found) + math.ceil(seconds * run.sample_rate)

        def first(rows: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(rows[..., :end])
        return replace(one, run=run.slice(0, end), window=first(one.window),
                       measured=first(one.measured), share=first(one.share), finding=first(one.finding),
                       segment=first(one.segment))
    return replace(data, records=tuple(map(cut, data.records)))


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


def clock_evidence(runs: Sequence[Run]) -> tuple[float, float] | None:
    """True over nominal sample period and its standard error, by regression of host_time on device_time.

    None where no run has both; a simulated device's virtual time is no clock.  The error is taken from the scatter of
    the residuals and, since receipt is never early, is not allowed below CLOCKS, however many runs there are.
    """
    slopes, weights = [], []
    for run in runs:
        if run.host_time is None or run.device_time is None or getattr(run.metadata, "clock", None) == "virtual":
            continue
        x, y = run.device_time - run.device_time.mean(), run.host_time - run.host_time.mean()
        slope = float(x @ y / (x @ x))
        spread = float(np.std(y - slope * x)) / math.sqrt(float(x @ x))
        slopes.append(slope)
        weights.append(max(spread, CLOCKS) ** -2)
    if not slopes:
        return None
    return float(np.average(slopes, weights=weights)), max(float(np.sum(weights)) ** -0.5, CLOCKS)
