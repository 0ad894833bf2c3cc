"""A plain Kalman filter and smoother of a linear rig under coloured disturbances: what a compiled predictor is held to.

State at tick k, before the command of row k acts: z (motion, see `plant`), and the disturbances that were held over the
last tick, torque on the motor (N m) and force on the tip (N), each Gauss-Markov:

    d_k = a d_k-1 + w_k,   a = exp(-h / time),   var w = (1 - a^2) sigma^2
    z_k+1 = Phi z_k + G u_k + G_d d_k,   held over the tick, exact (Van Loan 1978)
    y_k = C z_k + D (u_k-1, d_k-1) + v_k,   encoder and accelerometer, counts

One-step predictions, their covariances and the log likelihood in innovations form (Ljung, System Identification, 1999,
ch. 4 and 7), smoothed disturbances by de Jong's fixed-interval smoother (Biometrika 75, 1988). Dense matrices, row by
row; no controller, no effects: the logged command is the input.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .plant import linear_system, mechanics, transition
from .rigs import RigDict

Array = NDArray[np.float64]
TORQUE, FORCE = 0, 3  # inputs of the linear system


@dataclass(frozen=True)
class Coloured:
    """A stationary Gauss-Markov disturbance: sigma in N m (torque) or N (force), correlation time in s."""

    sigma: float
    time: float


@dataclass(frozen=True)
class Innovations:
    """Rows (n) of one-step prediction errors (n, channels) with covariances (n, channels, channels), counts."""

    errors: Array
    covariances: Array
    log_likelihood: float
    smoothed: Array  # (n, disturbances): what was held over each tick, given the whole run; the last row is foretold
    deviations: Array  # (n, disturbances): its standard deviation

    @property
    def whitened(self) -> Array:
        """Errors in units of their own covariance: white and of variance 1 if the model is right."""
        lower = np.linalg.cholesky(self.covariances)
        return np.linalg.solve(lower, self.errors[..., None])[..., 0]


def innovations(
    rig: RigDict,
    command: Array,
    readings: Array,
    *,
    torque: Coloured | None = None,
    force: Coloured | None = None,
    sigmas: tuple[float, ...] = (0.29, 1.0),
    start_spread: float = 1e-3,
) -> Innovations:
    """Filter and smooth one run of a rig without effects: command (n), readings (n, 1 or 2) in counts.

    `sigmas`: of the readings, counts. The run starts at rest at angle 0, known to `start_spread` rad and rad/s.
    """
    system = linear_system(mechanics(rig), rig["motor"]["gain"])
    phi, gain = transition(system, 1.0 / rig["sample_rate"])
    given = [(i, c) for i, c in ((TORQUE, torque), (FORCE, force)) if c is not None]
    inputs = [i for i, _ in given]
    nz, m, channels = len(phi), len(given), readings.shape[1]
    decay = np.diag([math.exp(-1.0 / rig["sample_rate"] / c.time) for _, c in given])
    fresh = np.diag([c.sigma**2 for _, c in given]) @ (np.eye(m) - decay @ decay)
    a = np.block([[phi, gain[:, inputs] @ decay], [np.zeros((m, nz)), decay]])
    b = np.concatenate([gain[:, 6], np.zeros(m)])
    shake = np.vstack([gain[:, inputs], np.eye(m)])
    q = shake @ fresh @ shake.T
    per = rig["encoder"]["counts_per_revolution"] / (2.0 * math.pi)
    c, d = np.zeros((channels, nz + m)), np.zeros(channels)
    c[0, :nz] = per * system.c_encoder
    if channels == 2:
        scale = rig["accelerometer"]["gain"]
        c[1] = scale * np.concatenate([system.c_acc, system.d_acc[inputs]])
        d[1] = scale * system.d_acc[6]
    noise = np.diag(np.square(sigmas[:channels]))
    x, p = np.zeros(nz + m), np.zeros((nz + m, nz + m))
    lift = mechanics(rig).lift[0]
    for part in (slice(0, system.nq), slice(system.nq, 2 * system.nq)):
        p[part, part] = start_spread**2 * np.outer(lift, lift)
    p[nz:, nz:] = np.diag([c.sigma**2 for _, c in given])
    n, last, total = len(command), 0.0, 0.0
    errors, covariances, predicted, steps = np.zeros((n, channels)), np.zeros((n, channels, channels)), [], []
    for k in range(n):
        predicted.append((x, p))
        see = c if k else np.hstack([c[:, :nz], np.zeros((channels, m))])  # row 0 is read before anything acts
        e, s = readings[k] - see @ x - d * last, see @ p @ see.T + noise
        errors[k], covariances[k] = e, s
        total -= 0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(2.0 * math.pi * s)[1])
        weight = np.linalg.solve(s, see @ p).T
        keep = np.eye(nz + m) - weight @ see
        steps.append(a @ keep)
        last = float(command[k])
        x = a @ (x + weight @ e) + b * last
        p = a @ (keep @ p @ keep.T + weight @ noise @ weight.T) @ a.T + q
    smoothed, deviations = np.zeros((n, m)), np.zeros((n, m))
    predicted.append((x, p))
    pull, known = np.zeros(nz + m), np.zeros((nz + m, nz + m))
    for k in range(n, 0, -1):  # the state at tick k holds what acted over tick k - 1
        x, p = predicted[k]
        if k < n:
            seen = np.linalg.solve(covariances[k], np.column_stack([errors[k], c]))
            pull = c.T @ seen[:, 0] + steps[k].T @ pull
            known = c.T @ seen[:, 1:] + steps[k].T @ known @ steps[k]
        smoothed[k - 1] = (x + p @ pull)[nz:]
        deviations[k - 1] = np.sqrt(np.diag(p - p @ known @ p)[nz:])
    return Innovations(errors, covariances, total, smoothed, deviations)
