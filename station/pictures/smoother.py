"""A random walk seen through a linear model: how large its steps are, and where it went.

The step makes the innovations most likely, together with a factor on the accelerometer's noise.  The smoother is that
of Rauch, Tung and Striebel (AIAA J. 3, 1965) in the form of Bryson and Frazier (Bierman, Automatica 9, 1973), which
needs no inverse of a covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from station.model.compiled import njit

SIZES = np.geomspace(1e-4, 1.0, 9)
"""Steps of the random walk that are tried first, of the motor's largest torque per sample."""
WANDER = 0.01
"""Step of the accelerometer's offset, counts per sample."""
SETTLED = 1e-3
"""Relative change per row below which a covariance counts as settled."""


class System(NamedTuple):
    """The state-space model that the smoother runs on; x = [modes, d of the row before, accelerometer's offset]."""

    f: np.ndarray
    h: np.ndarray
    r: np.ndarray
    """(channels) variance of each."""
    start: np.ndarray
    """Covariance at row 0."""
    noise: np.ndarray
    """(size, 2) how w and the offset's wandering enter."""

    def process(self, step: float) -> np.ndarray:
        """Process covariance for a step of the random walk."""
        return self.noise @ np.diag([step**2, WANDER**2]) @ self.noise.T


def likeliest(system: System, scale: float, excess: np.ndarray, forcing: np.ndarray,
              factors: Sequence[float]) -> tuple[System, float, float]:
    """The random walk's step and the accelerometer's mistrust of greatest likelihood; the system with that mistrust.

    Steps: a grid over four decades, refined by Brent's method beside the best.  Mistrust: ``factors`` in turn while
    the likelihood grows.
    """
    first, grid, before = system.process(scale), np.log(SIZES * scale), math.inf

    def cost(log: float, tried: System) -> float:
        return misfit(*tried[:4], tried.process(math.exp(log)), first, excess, forcing)

    for factor in factors:
        tried = system._replace(r=system.r * np.array([1.0, factor**2])[: excess.shape[1]])
        costs = [cost(log, tried) for log in grid]
        if min(costs) >= before:
            break
        before, best, chosen, mistrust = min(costs), int(np.argmin(costs)), tried, factor
    around = (grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)])
    found = minimize_scalar(cost, args=(chosen,), bounds=around, method="bounded", options={"xatol": 0.1})
    return chosen, math.exp(found.x), mistrust


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _times(a, x):
    """Matrix times vector."""
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        total = 0.0
        for j in range(a.shape[1]):
            total += a[i, j] * x[j]
        out[i] = total
    return out


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _sandwich(a, b):
    """a b a', for symmetric b."""
    half, out = np.zeros(a.shape), np.zeros(a.shape)
    for i in range(a.shape[0]):
        for k in range(a.shape[0]):
            for j in range(a.shape[0]):
                half[i, j] += a[i, k] * b[k, j]
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for k in range(a.shape[0]):
                total += half[i, k] * a[j, k]
            out[i, j] = out[j, i] = total
    return out


@njit(cache=True, nogil=True)
def _update(h, r, x, p, y, gain, spread, surprise):
    """Take in one row's channels one after the other; writes gains (c, m), variances (c) and innovations (c)."""
    size, cost = x.size, 0.0
    for c in range(y.size):
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += p[i, j] * h[c, j]
            gain[c, i] = total
        spread[c] = r[c]
        surprise[c] = y[c]
        for i in range(size):
            spread[c] += h[c, i] * gain[c, i]
            surprise[c] -= h[c, i] * x[i]
        for i in range(size):
            for j in range(size):
                p[i, j] -= gain[c, i] * gain[c, j] / spread[c]
        for i in range(size):
            gain[c, i] /= spread[c]
            x[i] += gain[c, i] * surprise[c]
        cost += math.log(spread[c]) + surprise[c] ** 2 / spread[c]
    return cost


@njit(cache=True, nogil=True)
def _settled(p, old, level):
    """Whether a covariance has stopped changing."""
    for i in range(p.shape[0]):
        for j in range(p.shape[0]):
            if abs(p[i, j] - old[i, j]) > level * math.sqrt(p[i, i] * p[j, j]):
                return False
    return True


@njit(cache=True, nogil=True)
def misfit(f, h, r, start, process, first, y, forcing):
    """Minus twice the logarithm of the innovations' likelihood, a constant aside.

    Once the covariance has settled (SETTLED) its gains stay, and a row costs one product of matrix and vector.
    """
    rows, channels = y.shape
    size = f.shape[0]
    x, p, steady = np.zeros(size), start.copy(), False
    gain, spread, surprise = np.zeros((channels, size)), np.zeros(channels), np.zeros(channels)
    total, constant = 0.0, 0.0
    for k in range(rows):
        if steady:
            for c in range(channels):
                e = y[k, c]
                for i in range(size):
                    e -= h[c, i] * x[i]
                for i in range(size):
                    x[i] += gain[c, i] * e
                total += e * e / spread[c]
            total += constant
            x = _times(f, x) + forcing[k]
            continue
        old = p.copy()
        total += _update(h, r, x, p, y[k], gain, spread, surprise)
        x = _times(f, x) + forcing[k]
        p = _sandwich(f, p) + (first if k == 0 else process)
        if k > 1 and _settled(p, old, SETTLED):
            steady = True
            constant = np.sum(np.log(spread))
    return total


@njit(cache=True, nogil=True)
def smooth(f, h, r, start, process, first, y, forcing, watched):
    """Smoothed states (n, size) and the variance of one of them (n), by the modified Bryson-Frazier recursion.

    Backwards, for each channel (K gain, S variance, e innovation):  l <- (I - K h)' l - h e/S,
    L <- (I - K h)' L (I - K h) + h h'/S;  between rows l <- F' l, L <- F' L F;  x_s = x - P l, P_s = P - P L P.
    """
    rows, channels = y.shape
    size = f.shape[0]
    xs, ps = np.zeros((rows, size)), np.zeros((rows, size, size))
    gains, spreads = np.zeros((rows, channels, size)), np.zeros((rows, channels))
    surprises, variance = np.zeros((rows, channels)), np.zeros(rows)
    x, p = np.zeros(size), start.copy()
    transposed = np.ascontiguousarray(f.T)
    for k in range(rows):
        xs[k], ps[k] = x, p
        _update(h, r, x, p, y[k], gains[k], spreads[k], surprises[k])
        x = _times(f, x) + forcing[k]
        p = _sandwich(f, p) + (first if k == 0 else process)
    pull, big = np.zeros(size), np.zeros((size, size))
    for k in range(rows - 1, -1, -1):
        for c in range(channels - 1, -1, -1):
            kl, klk = 0.0, 0.0
            lk = _times(big, gains[k, c])
            for i in range(size):
                kl += gains[k, c, i] * pull[i]
                klk += gains[k, c, i] * lk[i]
            slope = kl + surprises[k, c] / spreads[k, c]
            weight = klk + 1.0 / spreads[k, c]
            for i in range(size):
                pull[i] -= h[c, i] * slope
                for j in range(size):
                    big[i, j] += h[c, i] * h[c, j] * weight - h[c, i] * lk[j] - lk[i] * h[c, j]
        xs[k] -= _times(ps[k], pull)
        row = ps[k, watched]
        variance[k] = max(row[watched] - np.sum(row * _times(big, row)), 0.0)
        pull = _times(transposed, pull)
        big = _sandwich(transposed, big)
    return xs, variance
