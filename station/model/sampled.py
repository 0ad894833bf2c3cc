"""The linear part of a rig with its ports, truncated and sampled as the stepper takes it."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from station.model.assembly import Assembly, assemble, axis_moment, state_matrix
from station.model.compiled import njit
from station.model.modal import EXPONENTIAL, INTEGRAL, ITSELF, ModalForm, function, modal_form
from station.rig import Rig

PORT_SHARE = 0.02
"""Of the motor's largest torque, that with which a port's is reckoned."""


class _Tables:
    """A rig as its linear part sees it: equal where the tables are, whatever effects it has.

    ``moving``: as its motion alone sees it, whatever drives and reads it.
    """

    def __init__(self, rig: Rig, moving: bool = False) -> None:
        self.rig, motor = rig, rig.motor
        self._key: tuple[object, ...] = (motor.inertia, motor.damping, rig.drive, rig.base, rig.clamp, rig.beam,
                                         rig.tip)
        if not moving:
            self._key += (motor.gain, rig.accelerometer, rig.amplifier, rig.encoder)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Tables) and self._key == other._key


@dataclass(frozen=True, eq=False)
class Linear:
    """A rig without its effects."""

    assembly: Assembly
    whole: ModalForm
    """All its modes."""
    form: ModalForm
    """Those that are kept."""
    per_count: np.ndarray
    """(2 b) rate of these per count of command."""
    dropped: float
    """Bound of what the others could add to an output, counts."""


def linear(rig: Rig, ports: tuple[str, ...], h: float, substeps: int, switch_time: float, truncation: float,
           beside: Linear | None = None) -> tuple[Linear, dict[str, Any]]:
    """A rig without its effects, and what a ``stepper.Plan`` holds of it, by its names there.

    Kept are the modes that add more than ``truncation`` (counts) to an output sampled with a step of ``h`` (s), of
    which ``substeps`` make a period.  ``ports``: where effects put torques.  ``switch_time`` (s): within a step, when
    the command switches, 0: at its start.  ``beside``: a rig that may be near; where it is, the modes are told to first
    order in what is between them.
    """
    return _linear(_Tables(rig), ports, h, substeps, switch_time, truncation, beside)


@functools.lru_cache(maxsize=32)
def _decoupled(tables: _Tables, beside: Linear | None) -> tuple[Assembly, ModalForm]:
    """Kept, since a fit moves effects on the same linear part again and again."""
    parts = assemble(tables.rig)
    near = None
    if beside is not None and beside.assembly.size == parts.size:
        near = beside.whole.moved(state_matrix(parts) - state_matrix(beside.assembly))
    return parts, near or modal_form(parts)


@functools.lru_cache(maxsize=32)
def _linear(tables: _Tables, ports: tuple[str, ...], h: float, substeps: int, switch_time: float, truncation: float,
            beside: Linear | None) -> tuple[Linear, dict[str, Any]]:
    rig = tables.rig
    parts, whole = _decoupled(_Tables(rig, moving=True), beside)
    n, rotations = parts.size, np.stack([parts.rotation(at) for at in ("base", *ports)])
    inputs = rotations.T.copy()
    inputs[:, 0] = rig.motor.gain * parts.unit(parts.motor)
    forces = whole.inverse[:, n:] @ np.linalg.solve(parts.mass, inputs)
    angles, speeds = rotations @ whole.basis[:n], rotations @ whole.basis[n:]
    tip, gain = np.zeros(2 * whole.blocks), 0.0
    if parts.tip is not None and rig.accelerometer is not None:
        tip, gain = whole.basis[n + parts.tip], rig.accelerometer.gain
    keep, dropped = _truncate(rig, ports, whole, forces, angles, tip * gain, h * substeps, truncation)
    form, kept = whole.select(keep), whole.columns(keep)
    forces, angles, speeds = forces[kept].T.copy(), angles.take(kept, 1), speeds.take(kept, 1)
    moment = axis_moment(parts, rig.motor.damping) @ form.basis
    phi, held, switched, tip_acceleration, through, angle_gain, speed_gain, moment_gain = _responses(
        form.kind, form.eigenvalues, forces, angles, speeds, tip[kept], moment, h, switch_time)
    return Linear(parts, whole, form, forces[0], dropped), {
        "phi": phi, "held": held[0], "switched": switched, "base_angle": angles[0], "base_speed": speeds[0],
        "tip_acceleration": tip_acceleration, "tip_feedthrough": through[0], "port_angle": angles[1:],
        "port_speed": speeds[1:], "port_held": held[1:], "port_tip": through[1:], "angle_gain": angle_gain,
        "speed_gain": speed_gain, "moment": moment, "moment_gain": moment_gain, "counts_per_acceleration": gain}


def _truncate(rig: Rig, ports: tuple[str, ...], form: ModalForm, forces: np.ndarray, angles: np.ndarray,
              tip: np.ndarray, period: float, allowed: float) -> tuple[np.ndarray, float]:
    """Which blocks to keep, for the others cannot matter, and what these could add to an output, counts.

    A port's torque counts as PORT_SHARE of the motor's largest.  ``forces`` (2b, 1 + p): of one count, and of one N m
    at each port; ``angles`` (1 + p, 2b): rotations of the base and the ports, rad; ``tip`` (2b): its speed in counts
    of the accelerometer times s.  The rotation of a stiff joint at the beam's root is an output, too, in counts of the
    encoder: an effect acts on it, and every mode of the beam yields there.
    """
    largest = rig.amplifier.limit * forces
    largest[:, 1:] *= PORT_SHARE * rig.motor.gain
    outputs = angles[[0, *(1 + k for k, port in enumerate(ports) if port == "clamp")]] / rig.angle_per_count
    most = _bounds(form.kind, form.eigenvalues, outputs, tip, largest, period)
    order = np.argsort(most)
    total = np.cumsum(most[order])
    count = int(np.searchsorted(total, allowed))
    return np.sort(order[count:]), float(total[count - 1]) if count else 0.0


@njit(cache=True)
def _rate(row, rate):
    """(2b) a row of outputs times the blocks (4, b)."""
    out, b = np.empty_like(row), rate.shape[1]
    for i in range(b):
        out[i] = row[i] * rate[0, i] + row[b + i] * rate[2, i]
        out[b + i] = row[i] * rate[1, i] + row[b + i] * rate[3, i]
    return out


@njit(cache=True)
def _bounds(kind, eigenvalues, outputs, tip, largest, period):
    """(b) the most that every block could add to any output (o, 2b), or to the rate of the tip's speed (2b), by any
    input (2b, m), some of which the latter passes through at once; infinite of a mode that nothing brings back.

    A block with the output c and the sampled response g adds at most sum_k |c e^(A k T) g|, which
    |c| |g| / (1 - |e^(lambda T)|) bounds.
    """
    most, held, b = np.zeros(kind.size), function(kind, eigenvalues, INTEGRAL, period), kind.size
    tip_rate = _rate(tip, function(kind, eigenvalues, ITSELF, 1.0))
    for i in range(b):
        one, other = eigenvalues[i]
        decay = max(1.0 - math.exp(max(one.real, other.real) * period), 1e-12)
        for k in range(largest.shape[1]):
            first, second = largest[i, k], largest[b + i, k]
            response = math.hypot(held[0, i] * first + held[1, i] * second, held[2, i] * first + held[3, i] * second)
            for c in range(len(outputs)):
                most[i] = max(most[i], math.hypot(outputs[c, i], outputs[c, b + i]) * response / decay)
            most[i] = max(most[i], math.hypot(tip_rate[i], tip_rate[b + i]) * response / decay
                          + abs(tip[i] * first + tip[b + i] * second))
        if min(abs(one), abs(other)) == 0.0:
            most[i] = np.inf
    return most


@njit(cache=True)
def _responses(kind, eigenvalues, forces, angles, speeds, tip, moment, h, switch_time):
    """Of a plan: phi, held, switched, tip_acceleration, tip_feedthrough and the gains of angle, speed and moment.

    ``forces`` (1 + p, 2b): of one count, and of one N m at each port, and so is what they do; ``angles`` and ``speeds``
    (1 + p, 2b) of the base and at each port.
    """
    phi, whole = function(kind, eigenvalues, EXPONENTIAL, h), function(kind, eigenvalues, INTEGRAL, h)
    until = function(kind, eigenvalues, INTEGRAL, switch_time)
    after = function(kind, eigenvalues, EXPONENTIAL, h - switch_time)
    inputs, b = forces.shape[0], kind.size
    held, through, switched, ports = np.zeros_like(forces), np.zeros(inputs), np.zeros_like(tip), inputs - 1
    angle_gain, speed_gain, moment_gain = np.zeros((ports, ports)), np.zeros((ports, ports)), np.zeros(ports)
    for i in range(b):
        for k in range(inputs):
            one, two = forces[k, i], forces[k, b + i]
            held[k, i] = whole[0, i] * one + whole[1, i] * two
            held[k, b + i] = whole[2, i] * one + whole[3, i] * two
            through[k] += tip[i] * one + tip[b + i] * two
        if switch_time > 0.0:
            one, two = forces[0, i], forces[0, b + i]
            one, two = until[0, i] * one + until[1, i] * two, until[2, i] * one + until[3, i] * two
            switched[i] = after[0, i] * one + after[1, i] * two
            switched[b + i] = after[2, i] * one + after[3, i] * two
    for k in range(ports):
        for i in range(2 * b):
            moment_gain[k] += moment[i] * held[1 + k, i]
            for j in range(ports):
                angle_gain[j, k] += angles[1 + j, i] * held[1 + k, i]
                speed_gain[j, k] += speeds[1 + j, i] * held[1 + k, i]
    tip_acceleration = _rate(tip, function(kind, eigenvalues, ITSELF, 1.0))
    return phi, held, switched, tip_acceleration, through, angle_gain, speed_gain, moment_gain
