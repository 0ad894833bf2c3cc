"""Predictions of runs at a horizon or several: the compiled stepper, each time corrected by what an observer missed.

    e[i] = y[i] - yhat[i],   z+ = z + K e[i]/s,   d+ = d + k e[i]/s,   yhat[i+1] from z+, the logged command and phi d+

s is what the encoder's reading changes per count of the angle (1 but for an error of its own), z are the rig's modes, d
a torque at the motor (counts of command), e the encoder's error; with K = 0 this is the simulation driven by the logged
command.  The accelerometer is predicted and never fed back.  So nothing asks which controller closed the loop: the
direct method (Ljung 1999, section 13.4).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from station.estimation.dataset import Dataset
from station.estimation.filter import Slopes
from station.estimation.likelihood import blocks_independent
from station.estimation.observer import Observer, correction, slopes
from station.estimation.parameters import Parameters
from station.estimation.pool import Pool
from station.estimation.record import Logs
from station.model.compiled import kernel
from station.model.effects import Stage
from station.model.simulate import Model, build, initial_state
from station.model.stepper import (
    State,
    advance,
    advance_plain,
    begin,
    encoder_slope,
    is_plain,
    sense,
    sense_plain,
    working_room,
)
from station.rig import Rig

Accuracy = tuple[float, float, float]
"""Modes left out (counts), longest step (s), and that where a gap closes with a blow (s)."""
COARSE: Accuracy = (0.1, 1e-3, 1e-3)
SEARCH: Accuracy = (0.1, 1e-3, 5e-4)
FINE: Accuracy = (0.01, 5e-4, 2e-4)
"""Of the simulations in a search and of those from which values are stated, SEARCH and FINE; in a hurry COARSE and
SEARCH.  By COARSE predictions err by 0.02 count at most (root mean square, effects of all usual sizes on the arm), with
a gap by 0.05, by SEARCH with a gap by 0.012; rounding alone by 0.29."""


def built(rig: Rig, accuracy: Accuracy = SEARCH, beside: Model | None = None) -> Model:
    """A rig made ready for the many simulations of a fit; ``beside``: a rig near it."""
    truncation, longest, where_a_gap_closes = accuracy
    gap = any(effect.stage is Stage.GAP for effect in rig.effects)
    return build(rig, truncation, where_a_gap_closes if gap else longest, beside)


@kernel()
def _predict(plan, fresh, state, gain, torque_gain, late, decay, logs, own, accel_at, out, disturbance, work):
    blocks, horizons, plain = out.size // logs.command.size, accel_at.size, is_plain(plan)
    for run in range(len(own)):
        rows = logs.first[run + 1] - logs.first[run]
        for horizon in range(horizons):
            _restart(fresh, run, state)
            begin(plan, state)
            d = 0.0
            angles = blocks * logs.first[run] + horizon * rows
            accels = blocks * logs.first[run] + accel_at[horizon] * rows
            for i in range(rows):
                row = logs.first[run] + i
                used = horizons if logs.finding[row] and torque_gain[horizon] == 0.0 else horizon
                if torque_gain[used] == 0.0:
                    d = 0.0
                if plain:
                    encoder, accel = sense_plain(plan, state, own[run, 1])
                else:
                    encoder, accel = sense(plan, state, own[run, 1], False)
                out[angles + i] = encoder
                if accel_at[horizon] >= 0:
                    out[accels + i] = accel
                if torque_gain[used] != 0.0:
                    error = 0.0
                    if logs.read[row]:
                        error = (logs.encoder[row] - encoder) / encoder_slope(plan, state)
                    for k in range(state.z.size):
                        state.z[k] += gain[used, k] * error
                    for k in range(late.shape[1]):
                        state.angles[(state.clock[2] - k) % state.angles.size] += late[used, k] * error
                    d = decay[used] * (d + torque_gain[used] * error)
                if disturbance.size > 0:
                    disturbance[horizons * logs.first[run] + horizon * rows + i] = d
                command = logs.command[row]
                more = own[run, 2] * command + own[run, 3]
                if plain:
                    advance_plain(plan, state, command, more + d)
                else:
                    advance(plan, state, command, more + d, work)


@kernel()
def _restart(fresh, run, state):
    z, effects, last = fresh
    for i in range(state.z.size):
        state.z[i] = z[run, i]
    for i in range(state.effects.size):
        state.effects[i] = effects[run, i]
    for i in range(state.last.size):
        state.last[i] = last[run, i]
    state.torque[:] = 0.0
    state.commands[:] = 0.0
    state.clock[:] = 0


def is_compiled() -> bool:
    """Whether Numba's cache holds the code of predictions."""
    code = _predict.py_func.__code__
    return any(Path(_predict.stats.cache_path).glob(f"{Path(code.co_filename).stem}.{code.co_name}-*.nbi"))


@functools.lru_cache(maxsize=64)
def in_motion(data: Dataset, model: Model) -> Slopes:
    """What a rig's torques change where these runs move."""
    return slopes(model.rig, data.motion, data.carried)


def _predicted(data: Dataset, model: Model, observers: Sequence[Observer], logs: Logs, starts: Sequence[State],
               own: np.ndarray, accel_at: np.ndarray, blocks: int, disturbance: np.ndarray) -> np.ndarray:
    """Runs of a dataset by h observers: ``blocks`` channels of each, one run after another, counts, unrounded.

    ``starts``: every run's state at its first row; the first is used up.  ``own`` (runs, 4) as ``Dataset.own`` has it;
    ``accel_at`` (h): the block that holds the accelerometer as a horizon predicts it, -1 for none.
    """
    out: np.ndarray = np.empty(blocks * logs.command.size)
    used = [*observers, data.finder if logs.finding.any() else observers[0]]
    fresh = tuple(np.array(rows) for rows in zip(*((s.z, s.effects, s.last) for s in starts), strict=True))
    about = in_motion(data, model) if any(math.isfinite(one.horizon) for one in used) else ()
    states, torques, decays, angles = zip(*(correction(o, model, about) for o in used), strict=True)
    late = np.zeros((len(used), max(a.size for a in angles)))
    for row, angle in zip(late, angles, strict=True):
        row[: angle.size] = angle
    _predict(model.plan, fresh, starts[0], np.array(states), np.array(torques), late, np.array(decays),
             logs, np.ascontiguousarray(own), accel_at, out, disturbance, working_room(model.plan))
    return out


def _start(data: Dataset, model: Model, run: int, angle: float, zero: float, place: float) -> State:
    """A run's state at its first row, where the encoder reads ``angle`` (rad)."""
    return initial_state(model, angle_that_reads(model.rig, angle, zero), zero, gap_place=place,
                         equilibrium=data.runs[run].metadata.start == "equilibrium")


def predict_run(data: Dataset, model: Model, observers: Sequence[Observer], run: int, own: np.ndarray, *,
                zero: float = 0.0, place: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """One run by h observers: predicted channels (h, 2, n), counts, unrounded, and the observers' torque (h, n), counts
    of command.

    ``own`` (4) as ``Dataset.own`` has it.  Where a row was not logged, nothing was read, and the observer runs on with
    its torque, but for what ``Record.run`` says.
    """
    count, logs = len(observers), data.log[run]
    torque = np.zeros(count * logs.command.size)
    start = _start(data, model, run, float(own[0]), zero, place)
    out = _predicted(data, model, observers, logs, [start], own[None], np.arange(count, 2 * count), 2 * count, torque)
    return out.reshape(2, count, -1).transpose(1, 0, 2), torque.reshape(count, -1)


@dataclass(frozen=True, eq=False)
class Predictor:
    """Data, observers and accuracy: all that predictions need beside parameters.

    b blocks: the encoder at every horizon; the accelerometer at the last alone, for nothing of it is fed back and a
    beam rings by itself, so that its errors are the same at all.
    """

    data: Dataset
    observers: tuple[Observer, ...]
    pool: Pool
    accuracy: Accuracy = SEARCH
    final: Accuracy = FINE
    """Of the simulations from which values are stated."""
    beside: Model | None = None
    """A rig near those to come."""

    def near(self, space: Parameters, x: np.ndarray) -> Predictor:
        """The same, quicker for rigs like the one that a parameter vector describes."""
        model = self.model(space, x)
        about = in_motion(self.data, model)
        return replace(self, observers=tuple(observer.near(model, about) for observer in self.observers))

    def around(self, space: Parameters, x: np.ndarray) -> Predictor:
        """The same for rigs so near to the one that a parameter vector describes that they are told to first order, as
        derivatives by its constants want them."""
        return replace(self, beside=self.model(space, x))

    def on(self, data: Dataset) -> Predictor:
        """The same on other data of the same runs."""
        return replace(self, data=data)

    @cached_property
    def at_longest(self) -> Predictor:
        """The same at the longest horizon alone."""
        return replace(self, observers=self.observers[-1:])

    @cached_property
    def channel(self) -> np.ndarray:
        """(b) the channel of every block."""
        return np.array([0] * len(self.observers) + [1] * (self.data.has_accel and bool(self.observers)), dtype=int)

    @cached_property
    def longest(self) -> np.ndarray:
        """(b) whether a block is of the longest horizon; the accelerometer's always is."""
        return np.arange(len(self.channel)) >= len(self.observers) - 1

    @cached_property
    def ahead(self) -> np.ndarray:
        """(b) whether a block is no whole run of the encoder: those go by the commands alone."""
        return ~(self.longest & (self.channel == 0))

    @cached_property
    def counts(self) -> np.ndarray:
        """(runs, b) independent errors of the sensors."""
        return np.maximum([self.share(r).sum(axis=1) for r in range(len(self.data.runs))], 1e-9)

    @cached_property
    def power(self) -> np.ndarray:
        """(runs, b) mean square of what was read, from where a run began, in units of the noise."""
        data = self.data
        first = np.stack([data.start / data.rig.angle_per_count, data.offset][: data.channels], axis=1)
        found = [np.sum(((one.measured - f[:, None]) / data.sigma[:, None]) ** 2 * one.share, axis=1)
                 for one, f in zip(data.records, first, strict=True)]
        counts = np.maximum([one.share.sum(axis=1) for one in data.records], 1e-9)
        return (np.array(found) / counts)[:, self.channel]

    def measured(self, run: int) -> np.ndarray:
        """(b, n) what one run's predictions are held against, counts."""
        return self.data.records[run].measured[self.channel]

    def share(self, run: int) -> np.ndarray:
        """(b, n) independent errors per sample."""
        return self.data.records[run].share[self.channel]

    def scale(self, run: int) -> np.ndarray:
        """(b, n) what makes one run's errors count alike: root of the errors per sample over their sigma, 1/counts."""
        return self._scales[run]

    @cached_property
    def _scales(self) -> list[np.ndarray]:
        sigma = self.data.sigma[:, None]
        return [(np.sqrt(record.share) / sigma)[self.channel] for record in self.data.records]

    def independent(self, squares: np.ndarray, residuals: list[np.ndarray]) -> np.ndarray:
        """(runs, b) N of every block, from S (runs, b) and scaled errors (b, n) of every run."""
        return blocks_independent(squares, self.counts, self.power, residuals)

    def model(self, space: Parameters, x: np.ndarray) -> Model:
        """Of the rig that a parameter vector describes."""
        return built(space.rig_at(x), self.accuracy, self.beside)

    def some(self, model: Model, space: Parameters, x: np.ndarray, runs: Sequence[int], own: np.ndarray,
             ) -> list[np.ndarray]:
        """Predictions (b, n) of one run, or of all, counts; ``own`` (runs, 4) as ``Dataset.own`` has it."""
        data, count = self.data, len(self.observers)
        if not count:
            return [np.zeros((0, len(data.runs[r]))) for r in runs]
        logs = data.logs if len(runs) == len(data.runs) else data.log[runs[0]]
        starts = [_start(data, model, r, angle, space.zero(x, data.records[r].zero_group), space.place(x, r))
                  for r, angle in zip(runs, own[:, 0].tolist(), strict=True)]
        blocks, accel_at = len(self.channel), np.full(count, -1)
        accel_at[-1] = count if blocks > count else -1
        out = _predicted(data, model, self.observers, logs, starts, own, accel_at, blocks, np.zeros(0))
        return [rows.reshape(blocks, -1) for rows in np.split(out, blocks * logs.first[1:-1])]

    def runs(self, space: Parameters, x: np.ndarray, own: np.ndarray) -> list[np.ndarray]:
        """Every run's predictions (b, n), counts; ``own`` (runs, 4) as ``Dataset.own`` has it."""
        return self.some(self.model(space, x), space, x, range(len(self.data.runs)), own)


def angle_that_reads(rig: Rig, reading: float, zero: float) -> float:
    """The base angle (rad) at which an encoder with an error of its own shows a reading (rad)."""
    errors = [e for e in rig.effects if e.stage is Stage.ENCODER]
    angle = reading
    for _ in range(5 if errors else 0):
        counts = sum(type(e).law(angle + zero, 0.0, 0.0, e.arguments(rig), (), 0.0) for e in errors)
        angle = reading - counts * rig.angle_per_count
    return angle
