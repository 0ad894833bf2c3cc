"""The missing torque: what must have acted on the rig besides its own model, when nothing else is assumed.

The response to the logged command is simulated, the whole command chain of the rig included.  The model is linear, so
what the run shows beyond that obeys the same modes driven by one unknown torque d at a port, a random walk:

    x[i+1] = F x[i] + b d[i],   d[i] = d[i-1] + w[i],   w ~ N(0, q),   y[i] = H x[i] + D d[i-1] + noise

x holds the modal coordinates (exact zero-order hold), y is measured minus simulated: encoder and accelerometer, the
accelerometer with an offset that wanders slowly.  Sensors are read before the torque of row i acts, as everywhere.
q is the one that makes the innovations most likely.  The smoother is that of Rauch, Tung and Striebel (AIAA J. 3,
1965) in the form of Bryson and Frazier (Bierman, Automatica 9, 1973), which needs no inverse of a covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from station.diagnose.noise import QUANTISATION, noise_sigmas, rest_rows
from station.errors import UsageError
from station.model import stepper
from station.model.assembly import Assembly, assemble, torque_input
from station.model.compiled import njit
from station.model.effects import Effect, Stage
from station.model.effects.base import torque_scale
from station.model.modal import ModalForm, modal_form
from station.model.simulate import build, controller_arrays, initial_state
from station.rig import Rig
from station.runs.run import Run

SIZES = np.geomspace(1e-4, 1.0, 9)
"""Steps of the random walk that are tried first, of the motor's largest torque per sample."""
WANDER = 0.01
"""Step of the accelerometer's offset, counts per sample."""
_COMMAND_PATH = (Stage.COMMAND, Stage.INPUT_DELAY, Stage.CLOCK)
_ACCEL_PATH = (Stage.ACCEL_INPUT, Stage.ACCEL_FILTER, Stage.ACCEL_COUNTS, Stage.ACCEL_DELAY)


@dataclass(frozen=True)
class MissingTorque:
    """Arrays (n): row i is what acts from tick i to the next, like the command; motion at the middle between them."""

    t: np.ndarray
    torque: np.ndarray
    """N m on the part named, on a joint's two sides (+ motor, - base); at the tip a force, N."""
    sigma: np.ndarray
    """Its standard deviation, given the model."""
    angle: np.ndarray
    """Of the part, or a joint's deflection, rad; at the tip its position, m."""
    speed: np.ndarray
    speed_sigma: np.ndarray
    command: np.ndarray
    """Counts, as logged."""
    base_angle: np.ndarray
    """rad."""
    step: float
    """The random walk's step per sample that is most likely, N m."""


def port_vector(rig: Rig, parts: Assembly, at: str) -> np.ndarray:
    """Generalised torque of 1 N m (tip: force of 1 N) at a port, and the motion that it works on; UsageError if none."""
    if at == "motor":
        return parts.unit(parts.motor)
    if at == "base":
        return parts.unit(parts.base)
    if at == "drive" and rig.drive is not None:
        return parts.unit(parts.motor) - parts.unit(parts.base)
    if at == "clamp" and rig.clamp is not None and parts.root is not None:
        return parts.unit(parts.base) - parts.unit(parts.root)
    if at == "tip" and parts.tip is not None:
        return parts.unit(parts.tip)
    raise UsageError(f"missing torque: {rig.name} has no {at!r}")


def missing_torque(rig: Rig, run: Run, at: str = "motor", *, accelerometer: bool = True) -> MissingTorque:
    """Estimate the torque that is missing at ``at``: motor, base, drive, clamp or tip (there a force).

    The command chain that the rig holds (delay, lag and every static effect) acts on the logged command.  Torques that
    it holds at any port are evaluated on the smoothed motion and taken off; dry friction only while the part moves
    (beyond 3 sigma of its speed): what holds a resting part stays in the missing torque.  A delayed or eccentric
    encoder is corrected; an accelerometer that the rig holds effects for is not used, nor with ``accelerometer=False``.
    """
    run.require_unbroken()
    linear = rig.with_effects([e for e in rig.effects if e.stage in _COMMAND_PATH])
    model = build(linear)
    period = model.plan.h * model.plan.substeps
    parts = model.assembly
    form = _below_nyquist(modal_form(parts), period)
    use_accel = (accelerometer and rig.accelerometer is not None and run.accel is not None
                 and not any(e.stage in _ACCEL_PATH for e in rig.effects))
    simulated, angles, speeds = _driven(linear, model, run)
    port = port_vector(rig, parts, at)
    measured = [_true_encoder(rig, run.encoder, period)] + ([run.accel] if use_accel else [])
    excess = np.stack([m - s for m, s in zip(measured, simulated, strict=False)], axis=1)
    held, output, feed = _sampled(rig, parts, form, [port], period, use_accel)
    n, modes = parts.size, 2 * form.blocks
    size = modes + 1 + int(use_accel)
    f, h = np.zeros((size, size)), np.zeros((excess.shape[1], size))
    f[:modes, :modes] = _dense(form.exponential(period))
    f[:modes, modes] = held[0]
    f[modes, modes] = 1.0
    h[:, :modes], h[:, modes] = output, feed[0]
    noise = np.zeros((size, 2))
    noise[:modes, 0], noise[modes, 0] = held[0], 1.0
    if use_accel:
        f[-1, -1] = h[1, -1] = noise[-1, 1] = 1.0
    sigma = noise_sigmas([run])
    r = np.array([sigma[0] ** 2 + QUANTISATION, sigma[1] ** 2 + QUANTISATION])[: excess.shape[1]]
    scale = torque_scale(rig) / (rig.beam.length if at == "tip" and rig.beam else 1.0)
    start = _start_covariance(rig, parts, form, run, size)
    first = noise @ np.diag([scale**2, WANDER**2]) @ noise.T

    def process(step: float) -> np.ndarray:
        return noise @ np.diag([step**2, WANDER**2]) @ noise.T

    def cost(log_step: float) -> float:
        return -_likelihood(f, h, r, start, process(float(np.exp(log_step))), first, excess)

    grid = np.log(SIZES * scale)
    best = int(np.argmin([cost(g) for g in grid]))
    bounds = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    step = float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.15}).x))
    rows = np.zeros((2, size))
    rows[0, modes] = 1.0
    rows[1, :modes] = port @ form.basis[n:]
    states, variance = _smooth(f, h, r, start, process(step), first, excess, rows)
    known = np.zeros(len(run.t))
    laws = [e for e in rig.effects if e.stage in (Stage.TORQUE, Stage.FRICTION, Stage.GAP, Stage.SPRING)]
    if laws:
        states, known = _without_known(rig, parts, form, laws, run, (f, h, r, start, process(step), first, excess, rows),
                                       (states, variance), angles, speeds, at, port, period, use_accel)
    position = angles + states[:, :modes] @ form.basis[:n].T
    rate = speeds + states[:, :modes] @ form.basis[n:].T
    torque, sd = _next(states[:, modes]), np.sqrt(variance)
    return MissingTorque(run.t, torque, _next(sd[:, 0]), _middle(position @ port), _middle(rate @ port),
                         _middle(sd[:, 1]), run.command, _middle(position[:, parts.base]), step)


def _below_nyquist(form: ModalForm, period: float) -> ModalForm:
    """The modes that samples can show."""
    return form.select(np.flatnonzero(np.abs(form.eigenvalues).min(axis=1) < np.pi / period))


def _next(values: np.ndarray) -> np.ndarray:
    """Row i: the value held from tick i on, which the state notes at tick i + 1."""
    return np.append(values[1:], values[-1])


def _middle(values: np.ndarray) -> np.ndarray:
    """Row i: halfway between tick i and tick i + 1."""
    return 0.5 * (values + _next(values))
