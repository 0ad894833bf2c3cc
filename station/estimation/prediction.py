"""Predictions of runs at several horizons: the compiled stepper, each time corrected by what an observer missed.

    e[i] = y[i] - yhat[i],   z+ = z + K e[i],   d+ = d + k e[i],   yhat[i+1] from z+ with the logged command and phi d+

z are the rig's modes, d a torque at the motor (counts of command), e the encoder's error; with K = 0 this is the
simulation driven by the logged command.  The accelerometer is predicted and never fed back.  So nothing asks which
controller closed the loop: the direct method (Ljung 1999, section 13.4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from station.estimation.dataset import Dataset
from station.estimation.likelihood import blocks_independent
from station.estimation.observer import Observer
from station.estimation.parameters import Parameters
from station.model.compiled import kernel
from station.model.effects import Stage
from station.model.simulate import Model, build, initial_state
from station.model.stepper import State, advance, advance_plain, begin, is_plain, sense, sense_plain
from station.rig import Rig

Accuracy = tuple[float, float, float]
"""Modes left out (counts), longest step (s), and that where a gap closes with a blow (s)."""
SEARCH: Accuracy = (0.1, 1e-3, 5e-4)
FINE: Accuracy = (0.01, 5e-4, 2e-4)
"""Of the simulations in a search (errors below 0.1 count), and of those from which values are stated."""
SPAN = math.pi
"""Largest error of the angle that corrects a prediction, rad: a model that has run away is not chased."""


@kernel()
def _predict(plan, fresh, state, gain, torque_gain, decay, warm, span, offset, command, further, measured, logged,
             predicted, disturbance, work):
    horizons, plain = predicted.shape[0], is_plain(plan)
    for horizon in range(horizons):
        _restart(fresh, state)
        begin(plan, state)
        d = 0.0
        for row in range(command.size):
            used = horizons if row < warm else horizon
            if row == warm:
                d = 0.0
            if plain:
                encoder, accel = sense_plain(plan, state, offset)
            else:
                encoder, accel = sense(plan, state, offset, False)
            predicted[horizon, 0, row], predicted[horizon, 1, row] = encoder, accel
            if torque_gain[used] != 0.0:
                error = 0.0
                if logged[row]:
                    error = min(max(measured[0, row] - encoder, -span), span)
                for i in range(state.z.size):
                    state.z[i] += gain[used, i] * error
                d = decay[used] * (d + torque_gain[used] * error)
            disturbance[horizon, row] = d
            if plain:
                advance_plain(plan, state, command[row] + further[row] + d)
            else:
                advance(plan, state, command[row], further[row] + d, work)


@kernel()
def _restart(fresh, state):
    for i in range(fresh.z.size):
        state.z[i] = fresh.z[i]
    for i in range(fresh.torque.size):
        state.torque[i] = fresh.torque[i]
    for i in range(fresh.effects.size):
        state.effects[i] = fresh.effects[i]
    for i in range(fresh.commands.size):
        state.commands[i] = fresh.commands[i]
    for i in range(fresh.clock.size):
        state.clock[i] = fresh.clock[i]
    for i in range(fresh.last.size):
        state.last[i] = fresh.last[i]


def predict(model: Model, observers: Sequence[Observer], measured: np.ndarray, command: np.ndarray, *,
            start_angle: float, offset: float, zero: float = 0.0, gap_place: float = 0.0, equilibrium: bool = False,
            logged: np.ndarray | None = None, warm: tuple[Observer, int] | None = None,
            more: tuple[float, float] = (0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """One run by h observers: predicted channels (h, 2, n), counts, unrounded, and the observers' torque (h, n), counts
    of command.

    ``measured`` (2, n) counts, ``command`` (n) counts as logged; angles in rad.  Where ``logged`` (n) is False nothing
    was read, and the observer runs on with its torque.  ``warm``: the observer that finds the state in so many first
    rows, of a run that begins in motion.  ``more``: what the motor does more in this run, a share of the command and a
    constant (counts of command).
    """
    fresh = initial_state(model, start_angle, zero, equilibrium=equilibrium, gap_place=gap_place)
    state = State(*(np.zeros_like(array) for array in fresh))
    rows, (quick, found) = len(command), warm or (observers[0], 0)
    predicted, disturbance = np.zeros((len(observers), 2, rows)), np.zeros((len(observers), rows))
    used = [*observers, quick]
    _predict(model.plan, fresh, state, np.array([o.modal(model) for o in used]),
             np.array([o.torque for o in used]), np.array([o.decay for o in used]), found,
             SPAN / model.rig.angle_per_count, offset, command, more[0] * command + more[1], measured,
             np.ones(rows, dtype=bool) if logged is None else logged, predicted, disturbance,
             np.zeros((4, max(model.plan.port_joint.size, 1))))
    return predicted, disturbance


def predict_run(data: Dataset, model: Model, observers: Sequence[Observer], run: int, own: np.ndarray, *,
                zero: float = 0.0, place: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """As ``predict``, one run of a dataset; ``own`` (4) as ``Dataset.own`` has it."""
    this, rows = data.runs[run], data.warm[run]
    start, offset, share, constant = own.tolist()
    return predict(model, observers, data.measured[run], np.ascontiguousarray(this.command, dtype=float),
                   start_angle=angle_that_reads(model.rig, start, zero), offset=offset, zero=zero, gap_place=place,
                   equilibrium=this.metadata.start == "equilibrium", logged=data.logged[run], more=(share, constant),
                   warm=(data.finder, rows) if rows else None)


@dataclass(frozen=True, eq=False)
class Predictor:
    """Data, observers and accuracy: all that predictions need beside parameters.

    b blocks: the encoder at every horizon; the accelerometer at one alone, for nothing of it is fed back and a beam
    rings by itself, so that its errors are the same at all.
    """

    data: Dataset
    observers: tuple[Observer, ...]
    pool: Executor
    accuracy: Accuracy = SEARCH

    def on(self, data: Dataset) -> Predictor:
        """The same on other data of the same runs."""
        return replace(self, data=data)

    @cached_property
    def channel(self) -> np.ndarray:
        """(b) the channel of every block."""
        return np.array([0] * len(self.observers) + [1] * self._accelerometers, dtype=int)

    @property
    def _accelerometers(self) -> int:
        """How many blocks are the accelerometer's."""
        return self.data.channels - 1 if self.observers else 0

    @cached_property
    def counts(self) -> np.ndarray:
        """(runs, b) independent errors of the sensors."""
        return np.maximum([self.share(r).sum(axis=1) for r in range(len(self.data.runs))], 1e-9)

    @cached_property
    def power(self) -> np.ndarray:
        """(runs, b) mean square of what was read, from where a run began, in units of the noise."""
        data = self.data
        first = np.stack([data.start / data.rig.angle_per_count, data.offset], axis=1)
        found = [np.sum(((m[: data.channels] - f[: data.channels, None]) / data.sigma[:, None]) ** 2 * s, axis=1)
                 for m, s, f in zip(data.measured, data.share, first, strict=True)]
        return (np.array(found) / np.maximum(data.counts, 1e-9))[:, self.channel]

    def measured(self, run: int) -> np.ndarray:
        """(b, n) what one run's predictions are held against, counts."""
        return self.data.measured[run][self.channel]

    def share(self, run: int) -> np.ndarray:
        """(b, n) independent errors per sample."""
        return self.data.share[run][self.channel]

    def scale(self, run: int) -> np.ndarray:
        """(b, n) what makes one run's errors count alike, 1/counts.

        The square root of the independent errors per sample over the noise's variance.
        """
        return (np.sqrt(self.data.share[run]) / self.data.sigma[:, None])[self.channel]

    def independent(self, squares: np.ndarray, residuals: list[np.ndarray]) -> np.ndarray:
        """(runs, b) N of every block, from S (runs, b) and scaled errors (b, n) of every run."""
        return blocks_independent(squares, self.counts, self.power, residuals)

    def model(self, space: Parameters, x: np.ndarray) -> Model:
        """The rig that a parameter vector describes, made ready for the many simulations of a fit."""
        truncation, longest, longest_gap = self.accuracy
        return build(space.rig_at(x), truncation, longest_gap if space.gap_places else longest)

    def run(self, model: Model, space: Parameters, x: np.ndarray, run: int, own: np.ndarray) -> np.ndarray:
        """One run's predictions (b, n), counts; ``own`` (4) as ``Dataset.own`` has it."""
        zero, place = space.zero(x, self.data.zero_group[run]), space.place(x, run)
        if not self.observers:
            return np.zeros((0, len(self.data.runs[run])))
        found, _ = predict_run(self.data, model, self.observers, run, own, zero=zero, place=place)
        return np.concatenate([found[:, 0], found[len(found) // 2, [1] * self._accelerometers]])

    def runs(self, space: Parameters, x: np.ndarray, own: np.ndarray, *, parallel: bool = False) -> list[np.ndarray]:
        """Every run's predictions, ``own`` (runs, 4); ``parallel`` not from one of the pool's threads."""
        model = self.model(space, x)
        return list((self.pool.map if parallel else map)(
            lambda r: self.run(model, space, x, r, own[r]), range(len(self.data.runs))))


def angle_that_reads(rig: Rig, reading: float, zero: float) -> float:
    """The base angle (rad) at which an encoder with an error of its own shows a reading (rad)."""
    errors = [e for e in rig.effects if e.stage is Stage.ENCODER]
    angle = reading
    for _ in range(5 if errors else 0):
        counts = sum(type(e).law(angle + zero, 0.0, 0.0, e.arguments(rig), (), 0.0) for e in errors)
        angle = reading - counts * rig.angle_per_count
    return angle
