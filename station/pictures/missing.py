"""The missing torque: what must have acted on the rig besides its own model, when nothing else is assumed.

The response to the logged command is simulated, the rig's whole command chain included.  The model is linear, so what
the run shows beyond that obeys the same modes, driven by one unknown torque d at a port, a random walk:

    x[i+1] = F x[i] + b d[i] + known,   d[i] = d[i-1] + w[i],   w ~ N(0, q),   y[i] = H x[i] + D d[i-1] + noise

x holds the modal coordinates (exact zero-order hold), y is measured minus simulated: encoder and accelerometer, the
accelerometer with an offset that wanders slowly.  Sensors are read before the torque of row i acts, as everywhere.
q is the likeliest one (station.pictures.smoother).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from station.estimation.noise import QUANTISATION, noise_of
from station.model.along import TORQUES, axis_load, effective_command, held_torque, joint_torque, part_of, true_encoder
from station.model.effects import Effect, Stage
from station.model.effects.base import torque_scale
from station.model.modal import dense, modal_form
from station.model.simulate import build
from station.pictures.driven import driven_motion, resting
from station.pictures.plant import Motion, Plant, between, following, port_vector
from station.pictures.smoother import System, likeliest, smooth
from station.rig import Rig
from station.runs.run import Run

MISTRUST = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Factors on the accelerometer's noise: a beam that the model has wrong must not be made up for by torque."""
PASSES = 4
"""Times that torques which the rig holds are evaluated on the smoothed motion."""
TWISTED = 0.05
"""Standard deviation of the torque that twists the drive at an equilibrium, of the motor's largest."""
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
    mistrust: float
    """How many times noisier than at rest the accelerometer is taken: above 1 no torque at this place explains it."""
    by_accel: bool
    """Whether the accelerometer was used."""


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
    plant = Plant(rig, parts, form, period, 1 + int(use_accel))
    simulated, driven = driven_motion(model, run, *resting(rig, run))
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
        chosen, step, mistrust = likeliest(system, scale, seen, forcing, factors)
        x, variance = smooth(*chosen[:4], system.process(step), system.process(scale), seen, forcing, modes)
        motion = Motion(driven.angle + x[:, :modes] @ form.basis[:n].T, driven.speed + x[:, :modes] @ form.basis[n:].T)
        if k < passes:
            known, forcing, seen = _known(plant, laws, motion, _load(plant, motion, reaching), known, excess)
    return MissingTorque(run.t, following(x[:, modes]), np.sqrt(following(variance)),
                         *motion.along(port_vector(rig, parts, along or at)), run.command,
                         between(motion.speed[:, parts.base]), _load(plant, motion, reaching), mistrust, use_accel)


def _system(plant: Plant, port: np.ndarray, run: Run) -> System:
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
        spread.append(parts.unit(parts.motor) * TWISTED * torque_scale(rig) / rig.drive.stiffness)
    for vector in spread:
        z = form.inverse @ np.concatenate([vector, np.zeros(parts.size)])
        start[:modes, :modes] += np.outer(z, z)
    if channels == 2:
        f[-1, -1] = h[1, -1] = noise[-1, 1] = start[-1, -1] = 1.0
    sigmas = np.array(noise_of([run]).sigmas)
    steps = np.array([run.step("encoder"), run.step("accel")])
    return System(f, h, (sigmas**2 + QUANTISATION * steps**2)[:channels], start, noise)


def _load(plant: Plant, motion: Motion, command: np.ndarray) -> np.ndarray:
    """Load on the gears (n), N m; ``command`` as it reaches the motor's gain, counts."""
    rig = plant.rig
    if rig.drive is None:
        return axis_load(rig, command, between(motion.angle), between(motion.speed))
    return joint_torque(rig, "drive", *motion.along(port_vector(rig, plant.parts, "drive")), plant.period)


def _known(plant: Plant, laws: list[Effect], motion: Motion, load: np.ndarray, before: dict[str, np.ndarray],
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
