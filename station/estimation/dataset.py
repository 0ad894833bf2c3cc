"""Runs as an estimator sees them: what was read, how exactly, and what each run leaves unknown."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from station.errors import WorkError
from station.estimation.noise import QUANTISATION, accel_step, noise_of, rest_rows, rest_start, run_by_run
from station.estimation.observer import Observer, observers
from station.estimation.record import FIRST, Logs, Record, joined, record_of
from station.model.effects import USUAL_SPEED
from station.model.simulate import build, simulate_model
from station.rig import PROFILE, Rig
from station.runs.columns import place
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
MOTION = 256
"""Angles and speeds, and torques of a joint, that tell how runs move: of the slope of a law that levels off, two
thousandths beside all rows."""
RIGIDITY = 0.03
"""Sigma of each harmonic of a beam's rigidity along its length, where the rig file says nothing: the cube of a
thickness that varies by a percent (of cold rolled strip several are allowed: EN 10140), or a sensor's cable along it.
"""


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
        return joined(self.records)

    @cached_property
    def log(self) -> tuple[Logs, ...]:
        """Every run's rows by themselves."""
        return tuple(joined([record]) for record in self.records)

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
    whole = {at: np.concatenate(torques) for at, torques in found.items()}
    return {at: torque[_evenly(torque)] for at, torque in whole.items() if torque.any()}


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
        record_of(meshed, run, window, noise.sigmas[: 1 + has_accel], groups.index(zero),
                first + np.arange(len(run.t)) * count // len(run.t))
        for run, window, zero, first, count
        in zip(runs, windows or [slice(None)] * len(runs), zero_ids, np.cumsum(parts) - parts, parts, strict=True))
    return Dataset(meshed, records, noise=noise.sigmas, noise_freedoms=noise.freedoms, accel_noise=accel_noise,
                   clock=clock_evidence(tests), segment_run=np.repeat(np.arange(len(runs)), parts),
                   carried=_carried(meshed, tests))


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
