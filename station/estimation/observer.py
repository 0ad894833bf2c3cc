"""Observers whose memory is a given time: what makes a simulation a prediction that far ahead.

A steady Kalman filter of the linear rig, fed by the encoder alone, that takes what it missed for a torque at the motor
(Gauss-Markov, with the horizon as its correlation time).  The torque's size, the one number left, is chosen so that a
wrong angle is forgotten after the horizon: the integral over time of what a unit error of the angle leaves equals it.
An infinite horizon is the simulation driven by the logged command (output error).  Ljung, System Identification (2nd
ed., 1999), sections 3.2 (k-step-ahead predictors), 4.3 (innovations form) and 13.4 (direct method).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from station.estimation.noise import QUANTISATION
from station.model.assembly import torque_input
from station.model.compiled import njit
from station.model.modal import apply, dense
from station.model.simulate import Model, build
from station.rig import Rig

HORIZONS = (0.05, math.inf)
"""Seconds: what a torque does at once, and whole runs.  One between them reads what whole runs read: where a loop is
closed their slopes correlate by 0.9, and what counts twice makes causes that are not there look likely."""
ROUNDS = 20
"""Halvings of the logarithm of the torque's size."""
SIZES = (1e-4, 1e7)
"""Counts of command between which it is looked for."""
LASTS = 12.0
"""Horizons after which nothing is left of an error that is forgotten after one."""


@dataclass(frozen=True, eq=False)
class Observer:
    """Gains per count of the encoder's prediction error."""

    horizon: float
    state: np.ndarray
    """(2 n) on coordinates and speeds, rad and rad/s, deflections as shares of the beam's length."""
    torque: float
    """On the disturbance, counts of command."""
    decay: float
    """Of the disturbance from one sample to the next."""
    elements: int
    """Of the beam's mesh, 0 without one."""

    def correction(self, model: Model) -> Correction:
        """What one count of error changes in another rig's simulation, the same for all its runs.

        Of its own length and mesh, the correction as a shape the same.  What a sample corrects is the same whatever the
        board's clock: a speed counts in true seconds.  An encoder that is late shows what was to be corrected then: it
        is carried forward to now, by the rig without its effects, and so are the readings that have not been shown.
        Or a late encoder would be a worse observer than a late command that does the same.
        """
        return _correction(self, model)

    def _on(self, model: Model) -> np.ndarray:
        half = self.state.reshape(2, -1) / np.array([[1.0], [_period(model) / model.rig.period]])
        if model.rig.beam is None:
            return model.form.inverse @ half.ravel()
        at = half.shape[1] - 2 * self.elements
        shape = half[:, at - 1:]
        if model.rig.beam.elements != self.elements:
            shape = shape @ _finer(self.elements, model.rig.beam.elements).T
        found = np.concatenate([half[:, : at - 1], shape], axis=1)
        found[:, model.assembly.nodes] *= model.rig.beam.length
        return model.form.inverse @ found.ravel()


class Correction(NamedTuple):
    """What one count of the encoder's prediction error changes in a simulation."""

    state: np.ndarray
    """(2 b) modal coordinates."""
    torque: float
    """Disturbance, counts of command."""
    late: np.ndarray
    """(m) rad, angles that the encoder has yet to show: at the present instant, a step before, and so on."""


@functools.lru_cache(maxsize=64)
def _correction(observer: Observer, model: Model) -> Correction:
    plan, form, period, at_once = model.plan, model.form, _period(model), observer._on(model)
    if plan.encoder_delay == 0.0 or not at_once.any():
        return Correction(at_once, observer.torque, np.zeros(0))
    delay, count = plan.encoder_delay, _per_count(model)

    def carried(z: np.ndarray, torque: float, time: float) -> np.ndarray:
        return apply(form.exponential(time), z) + torque * apply(form.integral(time), count)

    begun = [(at_once, observer.decay * observer.torque)]     # what it has become when each period begins
    for _ in range(int(delay / plan.substeps)):
        z, torque = begun[-1]
        begun.append((carried(z, torque, period), observer.decay * torque))

    def after(steps: float) -> np.ndarray:
        whole = int(steps / plan.substeps)
        return carried(*begun[whole], (steps - whole * plan.substeps) * plan.h)

    late = [float(plan.base_angle @ after(delay - k)) for k in range(int(delay) + 1)]
    return Correction(after(delay), observer.torque * observer.decay ** (delay / plan.substeps), np.array(late))


def _period(model: Model) -> float:
    """True seconds between two samples, as the board's clock makes them."""
    return model.plan.substeps * model.plan.h


def _per_count(model: Model) -> np.ndarray:
    """(2 b) rate of the modes per count of torque at the motor."""
    parts = model.assembly
    return model.form.inverse @ (model.rig.motor.gain * torque_input(parts, parts.unit(parts.motor)))


def observers(rig: Rig, noise: float, horizons: Sequence[float] = HORIZONS) -> tuple[Observer, ...]:
    """One for each horizon (s); ``noise``: standard deviation of the encoder before rounding, counts."""
    linear = rig.with_effects([]).model_copy(update={"uncertainty": {}}).model_dump_json()
    return tuple(_observer(linear, noise**2 + QUANTISATION, horizon) for horizon in horizons)


@functools.lru_cache(maxsize=16)
def _finer(elements: int, wanted: int) -> np.ndarray:
    """(2 wanted + 1, 2 elements + 1) from [root's slope, deflection and slope of each further node] to those of another
    mesh, by the elements' own cubic shapes; lengths in units of the beam's."""
    size, h = 2 * elements + 1, 1.0 / elements
    ends = np.vstack([np.zeros((1, size)), np.eye(size)])       # the root's deflection is 0
    found = np.zeros((2 * wanted + 2, size))
    for k in range(wanted + 1):
        e = min(k * elements // wanted, elements - 1)
        s = k * elements / wanted - e
        w = np.array([1 - 3 * s**2 + 2 * s**3, h * (s - 2 * s**2 + s**3), 3 * s**2 - 2 * s**3, h * (s**3 - s**2)])
        slope = np.array([6 * s**2 - 6 * s, h * (1 - 4 * s + 3 * s**2), 6 * s - 6 * s**2, h * (3 * s**2 - 2 * s)]) / h
        found[2 * k], found[2 * k + 1] = w @ ends[2 * e: 2 * e + 4], slope @ ends[2 * e: 2 * e + 4]
    return found[1:]


@njit(cache=True)
def _memory(f, k, h, error, steps, period):
    """Time integral of the predicted angle's error after a unit one, s."""
    total = 0.0
    for _ in range(steps):
        e = np.dot(h, error)
        total += abs(e) * period
        error = np.dot(f, error - k * e)
    return total


@functools.lru_cache(maxsize=64)
def _observer(linear: str, variance: float, horizon: float) -> Observer:
    """Of a rig as JSON; kept, since a diagnosis asks for the same ones again and again."""
    model = build(Rig.model_validate_json(linear), 0.1, 1e-3)
    rig, form, period = model.rig, model.form, model.rig.period
    beam, elements = rig.beam, 0 if rig.beam is None else rig.beam.elements
    if math.isinf(horizon):
        return Observer(horizon, np.zeros(2 * model.assembly.size), 0.0, 0.0, elements)
    size, decay = 2 * form.blocks, math.exp(-period / horizon)
    held = dense(form.integral(period)) @ _per_count(model)
    f = np.zeros((size + 1, size + 1))
    f[:size, :size], f[:size, size], f[size, size] = dense(form.exponential(period)), held * decay, decay
    h = np.append(model.plan.base_angle * model.plan.counts_per_radian, 0.0)
    enters = np.append(held, 1.0)
    first = np.append(form.inverse @ np.concatenate([model.assembly.rigid, np.zeros(model.assembly.size)]), 0.0)

    def gain(log_size: float) -> np.ndarray:
        process = math.exp(2.0 * log_size) * (1.0 - decay**2) * np.outer(enters, enters)
        p = scipy.linalg.solve_discrete_are(f.T, h[:, None], process, [[variance]])
        return p @ h / (h @ p @ h + variance)

    def memory(log_size: float) -> float:
        return _memory(f, gain(log_size), h, first / (h @ first), math.ceil(LASTS * horizon / period), period)

    low, high = (math.log(s) for s in SIZES)
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if memory(middle) > horizon else (low, middle)
    k = gain(high)
    state = form.basis @ k[:size]
    if beam is not None:
        state[np.concatenate([model.assembly.nodes, model.assembly.size + model.assembly.nodes])] /= beam.length
    return Observer(horizon, state, float(k[size]), decay, elements)
