"""The missing torque: what must have acted on the rig besides its own model, when nothing else is assumed.

The response to the logged command is simulated, the rig's whole command chain included.  The model is linear, so what
the run shows beyond that obeys the same modes, driven by one unknown torque d at a port, a random walk:

    x[i+1] = F x[i] + b d[i] + known,   d[i] = d[i-1] + w[i],   w ~ N(0, q),   y[i] = H x[i] + D d[i-1] + noise

x holds the modal coordinates (exact zero-order hold), y is measured minus simulated: encoder and accelerometer, the
accelerometer with an offset that wanders slowly.  Sensors are read before the torque of row i acts, as everywhere.
q makes the innovations most likely, together with a factor on the accelerometer's noise.  The smoother is that of
Rauch, Tung and Striebel (AIAA J. 3, 1965) in the form of Bryson and Frazier (Bierman, Automatica 9, 1973), which needs
no inverse of a covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from station.errors import UsageError
from station.estimation.noise import QUANTISATION, noise_of, rest_start
from station.model import stepper
from station.model.along import TORQUES, axis_load, effective_command, held_torque, joint_torque, part_of, true_encoder
from station.model.assembly import Assembly, torque_input
from station.model.compiled import njit
from station.model.effects import Effect, Stage
from station.model.effects.base import torque_scale
from station.model.modal import ModalForm, dense, modal_form
from station.model.simulate import Model, build, controller_arrays, initial_state
from station.rig import Rig
from station.runs.run import Run

SIZES = np.geomspace(1e-4, 1.0, 9)
"""Steps of the random walk that are tried first, of the motor's largest torque per sample."""
MISTRUST = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Factors on the accelerometer's noise: a beam that the model has wrong must not be made up for by torque."""
WANDER = 0.01
"""Step of the accelerometer's offset, counts per sample."""
SETTLED = 1e-3
"""Relative change per row below which a covariance counts as settled."""
PASSES = 4
"""Times that torques which the rig holds are evaluated on the smoothed motion."""
_COMMAND_PATH = (Stage.COMMAND, Stage.INPUT_DELAY, Stage.CLOCK)
_ACCEL_PATH = (Stage.ACCEL_INPUT, Stage.ACCEL_FILTER, Stage.ACCEL_COUNTS, Stage.ACCEL_DELAY)


@dataclass(frozen=True)
class MissingTorque:
    """Arrays (n).  Row i is what acts from tick i to the next, like the command; motion is that between the two."""

    t: np.ndarray
    torque: np.ndarray
    """N m on the part named; on a joint: + on its motor side, - on the other; at the tip a force, N."""
    sigma: np.ndarray
    """Its standard deviation, given the model."""
    angle: np.ndarray
    """Of the part, or a joint's deflection, rad, from encoder count 0; at the tip its position, m."""
    speed: np.ndarray
    command: np.ndarray
    """Counts, as logged."""
    base_speed: np.ndarray
    load: np.ndarray
    """On the gears, with the effects that the rig holds, N m: the drive's torque; without a drive see axis_load."""
    step: float
    """The likeliest step of the random walk per sample, N m (N)."""
    mistrust: float
    """How many times noisier than at rest the accelerometer is taken: above 1 no torque at this place explains it."""
    by_accel: bool
    """Whether the accelerometer was used."""


class _Plant(NamedTuple):
    """The rig's linear model: torques held over a period drive its modes, from which the channels are read."""

    rig: Rig
    parts: Assembly
    form: ModalForm
    period: float
    channels: int
    """1: the encoder; 2: the accelerometer as well."""

    @property
    def modes(self) -> int:
        """Number of modal coordinates."""
        return 2 * self.form.blocks

    def response(self, port: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the modes (modes) to 1 N m held over a period, output rows (channels, modes), and outputs at once."""
        rig, parts, form, period, channels = self
        force = form.inverse @ torque_input(parts, port)
        rows, feed = [form.basis[parts.base] / rig.angle_per_count], [0.0]
        if channels == 2 and rig.accelerometer is not None and parts.tip is not None:
            tip = rig.accelerometer.gain * form.basis[parts.size + parts.tip]
            rows.append(tip @ dense(form.rates()))
            feed.append(float(tip @ force))
        return dense(form.integral(period)) @ force, np.array(rows), np.array(feed)


class _System(NamedTuple):
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


class _Motion(NamedTuple):
    """Angles and speeds of all coordinates at the ticks, (n, coordinates)."""

    angle: np.ndarray
    speed: np.ndarray

    def along(self, port: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle and speed of a port (see ``port_vector``), each (n), between a tick and the next."""
        return _between(self.angle @ port), _between(self.speed @ port)


def missing_torque(rig: Rig, run: Run, at: str = "motor", *, along: str = "",
                   accelerometer: bool = True) -> MissingTorque:
    """Estimate the torque that is missing at ``at``: motor, base, drive, clamp or tip (there a force).

    ``along``: the place whose angle and speed are told, by default ``at``.

    The command chain that the rig holds (delay, lag and every static effect) acts on the logged command.  Torques that
    it holds at any place are evaluated on the smoothed motion and are not part of the answer; of dry friction that is
    so only while the part moves: what holds a resting part stays in the answer, up to the friction's level.  Of
    sensors' effects the encoder's delay and eccentricity are undone; an accelerometer that the rig holds effects for
    is not used, nor is it with ``accelerometer=False``.  Angles count from encoder count 0: for a run with another
    zero, effects that refer to an angle are evaluated elsewhere.  UsageError: the rig has no such place.
    """
    run.require_unbroken()
    model = build(rig.with_effects([e for e in rig.effects if e.stage in _COMMAND_PATH]))
    period, parts = model.plan.h * model.plan.substeps, model.assembly
    form = modal_form(parts)
    form = form.select(np.flatnonzero(np.abs(form.eigenvalues).min(axis=1) < math.pi / period))
    port = port_vector(rig, parts, at)
    use_accel = (accelerometer and rig.accelerometer is not None and run.accel is not None
                 and not any(e.stage in _ACCEL_PATH for e in rig.effects))
    plant = _Plant(rig, parts, form, period, 1 + int(use_accel))
    simulated, driven = _driven(model, run, *resting(rig, run))
    measured = [true_encoder(rig, run.encoder)] + ([run.accel] if use_accel else [])
    excess = np.stack([m - s for m, s in zip(measured, simulated, strict=False)], axis=1)
    scale = torque_scale(rig) / (rig.beam.length if at == "tip" and rig.beam else 1.0)
    system = _system(plant, port, run)
    n, modes = parts.size, plant.modes
    laws = [e for e in rig.effects if e.stage in TORQUES]
    forcing = np.zeros((len(run.t), system.f.shape[0]))
    known: dict[str, np.ndarray] = {}
    reaching = effective_command(rig, run.command) if rig.drive is None else run.command
    seen = excess
    passes = PASSES if laws else 1
    for k in range(1, passes + 1):
        factors = MISTRUST if use_accel and k == passes else MISTRUST[:1]
        chosen, step, mistrust = _likeliest(system, scale, seen, forcing, factors)
        x, variance = _smooth(*chosen[:4], system.process(step), system.process(scale), seen, forcing, modes)
        motion = _Motion(driven.angle + x[:, :modes] @ form.basis[:n].T, driven.speed + x[:, :modes] @ form.basis[n:].T)
        if k < passes:
            known, forcing, seen = _known(plant, laws, motion, _load(plant, motion, reaching), known, excess)
    return MissingTorque(run.t, _next(x[:, modes]), np.sqrt(_next(variance)),
                         *motion.along(port_vector(rig, parts, along or at)), run.command,
                         _between(motion.speed[:, parts.base]), _load(plant, motion, reaching), step, mistrust,
                         use_accel)


def port_vector(rig: Rig, parts: Assembly, at: str) -> np.ndarray:
    """Generalised torque of 1 N m (tip: force of 1 N) at a place, and the motion that it works on, by virtual work."""
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
    raise UsageError(f"missing torque at {at!r}: rig {rig.name} has no such place")


def _next(values: np.ndarray) -> np.ndarray:
    """Row i: what is held from tick i on, which the state notes at tick i + 1."""
    return np.append(values[1:], values[-1:], axis=0)


def _between(values: np.ndarray) -> np.ndarray:
    """Row i: halfway between tick i and the next."""
    return 0.5 * (values + _next(values))


def resting(rig: Rig, run: Run) -> tuple[float, float]:
    """A run's starting angle (rad) and its accelerometer's offset (counts), means over the rows at rest."""
    rest = rest_start(run)
    start = float(np.mean(true_encoder(rig, run.encoder[rest]))) * rig.angle_per_count
    return start, 0.0 if run.accel is None else float(np.mean(run.accel[rest]))


def _driven(model: Model, run: Run, start: float, offset: float) -> tuple[tuple[np.ndarray, np.ndarray], _Motion]:
    """Channels (encoder, accel) and motion that the logged command causes on the model."""
    rows, size = len(run.t), model.assembly.size
    state = initial_state(model, start, equilibrium=run.metadata.start == "equilibrium")
    controller = controller_arrays({"kind": "open"}, model.rig)
    encoder, accel, history = np.zeros(rows), np.zeros(rows), np.zeros((rows, state.z.size))
    stepper.run_ticks(model.plan, state, controller, run.reference, np.array(run.command), False, 0, offset, False,
                      False, encoder, accel, history)
    full = history @ model.form.basis.T
    return (encoder, accel), _Motion(full[:, :size], full[:, size:])


def _system(plant: _Plant, port: np.ndarray, run: Run) -> _System:
    """Modes, unknown torque and the accelerometer's offset.

    At rest the rig's angle is known to a count; where the start is an equilibrium, its drive may be twisted.
    """
    rig, parts, form, period, channels = plant
    held, rows, feed = plant.response(port)
    modes, size = plant.modes, plant.modes + channels
    f, h, noise, start = np.zeros((size, size)), np.zeros((channels, size)), np.zeros((size, 2)), np.zeros((size, size))
    f[:modes, :modes], f[:modes, modes], f[modes, modes] = dense(form.exponential(period)), held, 1.0
    h[:, :modes], h[:, modes] = rows, feed
    noise[:modes, 0], noise[modes, 0] = held, 1.0
    spread = [parts.rigid * rig.angle_per_count]
    if rig.drive is not None and run.metadata.start == "equilibrium":
        spread.append(parts.unit(parts.motor) * 0.05 * torque_scale(rig) / rig.drive.stiffness)
    for vector in spread:
        z = form.inverse @ np.concatenate([vector, np.zeros(parts.size)])
        start[:modes, :modes] += np.outer(z, z)
    if channels == 2:
        f[-1, -1] = h[1, -1] = noise[-1, 1] = start[-1, -1] = 1.0
    sigmas = noise_of([run]).sigmas
    return _System(f, h, np.array([s**2 + QUANTISATION for s in sigmas[:channels]]), start, noise)


def _likeliest(system: _System, scale: float, excess: np.ndarray, forcing: np.ndarray,
               factors: Sequence[float]) -> tuple[_System, float, float]:
    """The random walk's step and the accelerometer's mistrust of greatest likelihood; the system with that mistrust.

    Steps: a grid over four decades, refined by golden section.  Mistrust: ``factors`` in turn while the likelihood
    grows.
    """
    first, grid, before = system.process(scale), np.log(SIZES * scale), math.inf

    def cost(log: float, tried: _System) -> float:
        return _misfit(*tried[:4], tried.process(math.exp(log)), first, excess, forcing)

    for factor in factors:
        tried = system._replace(r=system.r * np.array([1.0, factor**2])[: excess.shape[1]])
        costs = [cost(log, tried) for log in grid]
        if min(costs) >= before:
            break
        before, best, chosen, mistrust = min(costs), int(np.argmin(costs)), tried, factor
    around = (grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)])
    found = minimize_scalar(cost, args=(chosen,), bounds=around, method="bounded", options={"xatol": 0.1})
    return chosen, math.exp(found.x), mistrust


def _load(plant: _Plant, motion: _Motion, command: np.ndarray) -> np.ndarray:
    """Load on the gears (n), N m; ``command`` as it reaches the motor's gain, counts."""
    rig = plant.rig
    if rig.drive is None:
        return axis_load(rig, command, _between(motion.angle), _between(motion.speed))
    return joint_torque(rig, "drive", *motion.along(port_vector(rig, plant.parts, "drive")), plant.period)


def _known(plant: _Plant, laws: list[Effect], motion: _Motion, load: np.ndarray, before: dict[str, np.ndarray],
           excess: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """The rig's own torques on a motion, by place; their push on the state (n, size), and the channels without them."""
    rig = plant.rig
    forcing, seen = np.zeros((len(excess), plant.modes + plant.channels)), excess.copy()
    torques = {}
    for at in dict.fromkeys(part_of(rig, e) for e in laws):
        port = port_vector(rig, plant.parts, at)
        torques[at] = torque = held_torque(rig, at, *motion.along(port), load, before.get(at, 0.0), plant.period)
        held, _, feed = plant.response(port)
        forcing[:, :plant.modes] += np.outer(torque, held)
        seen[1:] -= np.outer(torque[:-1], feed)
    return torques, forcing, seen


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
def _misfit(f, h, r, start, process, first, y, forcing):
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
def _smooth(f, h, r, start, process, first, y, forcing, watched):
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
