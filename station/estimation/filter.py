"""The steady Kalman filter of a linear rig whose torque is disturbed, and how long it remembers a wrong angle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.optimize import brentq

from station.model.compiled import njit
from station.model.modal import EXPONENTIAL, INTEGRAL, ModalForm, dense, function
from station.model.simulate import Model

SIZES = math.log(1e-8), math.log(1e4)
"""Logarithms of shares of the amplifier's limit between which the disturbance's size is looked for, from below."""
STEPS = 6
"""Most steps of the secant method from one rig's to another's."""
NEAR = 1e-5
"""Error of the memory's logarithm from which on one step more is the last: it leaves the square of that."""
SLOPE, FLAT = -1.0 / 3.0, -0.05
"""Change of the memory's logarithm by that of the size, of a double integrator and to begin with; and the flattest that
is stepped along."""
LONGEST = 4.0
"""The longest such step, in the logarithm of the size."""
WALK, EXACT = math.ceil(SIZES[1] - SIZES[0]), 1e-12
"""Units of the logarithm over which a size is looked for one by one where such steps lead nowhere (a load on a loose
joint is forgotten hardly sooner over some units, and then sooner again), and its error."""
LASTS = 12.0
"""Horizons after which nothing is left of an error that is forgotten after one, and the covariance has settled."""
Slopes = tuple[tuple[str, float], ...]
"""Parts (motor, base) and what a torque there changes with their speed where the runs move, N m s/rad; joints (drive,
clamp) and by how much they are stiffer where the runs load them, N m/rad."""


class Filter(NamedTuple):
    """The linear rig with the disturbance as one more state, s = 2 b + 1."""

    f: np.ndarray
    """(s, s) from sample to sample."""
    h: np.ndarray
    """(s) the encoder, counts."""
    enters: np.ndarray
    """(s) how a disturbance of one count enters."""
    first: np.ndarray
    """(s) an error of one count of the angle, at rest."""
    decay: float
    period: float
    """Between two samples by the board's clock, s: by that horizons count, whatever a hypothesis says of it."""


def filter_of(model: Model, horizon: float, blocks: np.ndarray, about: Slopes = ()) -> Filter:
    """Of a rig's modes ``blocks`` alone, for a horizon, s; ``about``: the slopes of its torques where it moves."""
    form, kept, decay = model.form, model.form.columns(blocks), math.exp(-model.rig.period / horizon)
    still = form.inverse[kept, : model.assembly.size] @ model.assembly.rigid
    shown = model.plan.base_angle[kept] * model.plan.counts_per_radian
    if about:
        f, enters = _about(model, blocks, about, decay)
    else:
        f, enters = _transition(form.kind[blocks], form.eigenvalues[blocks], model.per_count[kept], decay,
                                true_period(model))
    return Filter(f, np.append(shown, 0.0), enters, np.append(still / (shown @ still), 0.0), decay, model.rig.period)


@njit(cache=True)
def _transition(kind, eigenvalues, per_count, decay, period):
    """``Filter.f`` and ``Filter.enters``."""
    free, held = function(kind, eigenvalues, EXPONENTIAL, period), function(kind, eigenvalues, INTEGRAL, period)
    half, size = kind.size, per_count.size
    f, enters = np.zeros((size + 1, size + 1)), np.ones(size + 1)
    for i in range(half):
        j = half + i
        f[i, i], f[i, j], f[j, i], f[j, j] = free[0, i], free[1, i], free[2, i], free[3, i]
        enters[i] = held[0, i] * per_count[i] + held[1, i] * per_count[j]
        enters[j] = held[2, i] * per_count[i] + held[3, i] * per_count[j]
    for i in range(size + 1):
        f[i, size] = enters[i] * decay
    return f, enters


def _about(model: Model, blocks: np.ndarray, about: Slopes, decay: float) -> tuple[np.ndarray, np.ndarray]:
    """The same of a rig on which torques of these slopes act, which join its modes."""
    form, kept, parts = model.form.select(blocks), model.form.columns(blocks), model.assembly
    size, n = len(kept), parts.size
    held = np.zeros((size + 1, size + 1))
    held[:size, :size], held[:size, size] = dense(form.rates()), model.per_count[kept]
    for at, slope in about:
        on = parts.rotation(at)
        by = on @ form.basis[n:] if at in ("motor", "base") else -on @ form.basis[:n]
        held[:size, :size] += np.outer(form.inverse[:, n:] @ np.linalg.solve(parts.mass, on), slope * by)
    f = scipy.linalg.expm(true_period(model) * held)
    enters = np.append(f[:size, size], 1.0)
    f[:, size] = enters * decay
    return f, enters


def true_period(model: Model) -> float:
    """True seconds between two samples, as the board's clock makes them."""
    return model.plan.substeps * model.plan.h


def speeds(form: ModalForm) -> np.ndarray:
    """(b) how fast a mode decays or swings, rad/s; of two that decay the slower."""
    return np.abs(form.eigenvalues).min(axis=1)


def fed_back(system: Filter, gain: np.ndarray, horizon: float) -> tuple[float, float]:
    """Mean squares of prediction errors and of the torque by white noise of the encoder, of variance one."""
    error, errors, torques, left = 1.0, 0.0, 0.0, np.zeros(len(gain))
    for _ in range(math.ceil(LASTS * horizon / system.period)):
        errors += error * error
        left = system.f @ (left + gain * error)
        error, torques = -float(system.h @ left), torques + float(left[-1] ** 2)
    return errors, torques


def forgets_within(system: Filter, variance: float, horizon: float, log_size: float) -> bool:
    """Whether a wrong angle is forgotten within the horizon where the torque has that size."""
    return log_memory(system, variance, horizon, log_size) < 0.0


def log_memory(system: Filter, variance: float, horizon: float, log_size: float) -> float:
    """Logarithm of the time after which a wrong angle is forgotten where the torque has that size, over the horizon."""
    return _excess(system, horizon, steady_gain(system, variance, log_size, _doublings(horizon, system.period)))


def designed(system: Filter, variance: float, horizon: float, log_size: float,
              slope: float) -> tuple[np.ndarray, float, float]:
    """(s) gain whose memory is the horizon, the logarithm of the torque's size, and the slope there."""
    before, doublings = log_size, _doublings(horizon, system.period)

    def missed_at(size: float) -> float:
        return _excess(system, horizon, steady_gain(system, variance, size, doublings))

    missed = missed_at(before)
    for _ in range(STEPS):
        here = before - min(max(missed / slope, -LONGEST), LONGEST)
        found = steady_gain(system, variance, here, doublings)
        if abs(missed) < NEAR:
            return found, here, slope
        now = _excess(system, horizon, found)
        if here > before and now - missed > FLAT * (here - before):
            break
        slope = min((now - missed) / (here - before), FLAT)
        before, missed = here, now
    size = _first_crossing(missed_at, before, missed)
    return steady_gain(system, variance, size, doublings), size, FLAT


def _first_crossing(missed_at: Callable[[float], float], size: float, missed: float) -> float:
    """The nearest size at which the memory is the horizon, the one way that leads there; where none is, ``size``."""
    way, here = math.copysign(1.0, missed), size
    for _ in range(WALK):
        if missed_at(here + way) * missed <= 0.0:
            return float(brentq(missed_at, here, here + way, xtol=EXACT))
        here += way
    return size


def _doublings(horizon: float, period: float) -> int:
    """Of the rows over which the filter's covariance settles."""
    return math.ceil(math.log2(LASTS * horizon / period) - 1e-6)


@njit(cache=True, nogil=True, error_model="numpy")
def steady_gain(system, variance, log_size, doublings):
    """(s) gain of the filter, its covariance by the doubling algorithm (Anderson and Moore, Optimal Filtering, 1979,
    section 6.7); not finite where it has none."""
    f, h, enters, _, decay, _ = system
    size = h.size
    a, row, column = f.T.copy(), h.reshape((1, size)), h.reshape((size, 1))
    g = _product(column, row / variance)
    p = _product(enters.reshape((size, 1)), enters.reshape((1, size)) * (math.exp(2.0 * log_size) * (1.0 - decay**2)))
    for _ in range(doublings):
        plus = _product(g, p)
        for i in range(size):
            plus[i, i] += 1.0
        b, c, transposed = _solved(plus, a), _solved(plus, g), a.T.copy()
        p = p + _product(transposed, _product(p, b))
        p = 0.5 * (p + p.T)
        g = g + _product(a, _product(c, transposed))
        a = _product(a, b)
    seen = _product(p, column)
    return seen[:, 0] / (_product(row, seen)[0, 0] + variance)


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _excess(system, horizon, gain):
    """Logarithm of the time integral of what a unit error of the angle leaves, over the horizon."""
    f, h, _, first, _, period = system
    size, total, error, moved, through = h.size, 0.0, first.copy(), np.empty(h.size), np.dot(f, gain)
    for _ in range(math.ceil(LASTS * horizon / period)):
        shown = 0.0
        for i in range(size):
            shown += h[i] * error[i]
        total += abs(shown) * period
        for i in range(size):
            moved[i] = -through[i] * shown
            for j in range(size):
                moved[i] += f[i, j] * error[j]
        error, moved = moved, error
    return math.log(total / horizon)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _product(a, b):
    """a b."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _solved(a, b):
    """a^-1 b, by elimination with partial pivoting; not finite where there is none.

    numpy.linalg.solve takes Numba a quarter of a minute to compile, and is no quicker for matrices of this size.
    """
    a, out, size = a.copy(), b.copy(), a.shape[0]
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        for j in range(k, size):
            a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
        for j in range(size):
            out[k, j], out[pivot, j] = out[pivot, j], out[k, j]
        for i in range(k + 1, size):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, size):
                a[i, j] -= factor * a[k, j]
            for j in range(size):
                out[i, j] -= factor * out[k, j]
    for k in range(size - 1, -1, -1):
        for i in range(k + 1, size):
            for j in range(size):
                out[k, j] -= a[k, i] * out[i, j]
        for j in range(size):
            out[k, j] /= a[k, k]
    return out
