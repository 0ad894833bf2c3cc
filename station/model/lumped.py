"""The discrete-time transfer matrix method, and the lumped chain that it steps.

After Krauss and Okasha (Discrete-Time Transfer Matrix Modeling of Flexible Robots under Feedback Control,
ACC 2013). The beam is N rigid lumps joined by N massless Euler beams of length h = L/N; each lump takes the
half piece on either side with its mass and rotary inertia, so the root's lump weighs in by its rotary
inertia alone and the last one carries the tip.  Massless Euler beams are the static beam elements exactly,
so the chain's stiffness and damping are those of ``assemble`` with N elements; only the mass matrix
differs, and is diagonal.

In time, Newmark's rule (gamma = 1/2, beta = 1/4) eliminates velocity and acceleration at the end of a step
of dt:

    x' = d x + e,   d = 2 / dt,     e = -d x_n - x'_n
    x'' = a x + b,  a = 4 / dt^2,   b = -a x_n - (4 / dt) x'_n - x''_n

Each part then relates the displacements and loads on its two sides by numbers, as a transfer matrix with a
column for the history.  As in ``transfer_matrix`` the relation load = S displacement + p is carried from
the tip to the motor (the Riccati form), and the displacements back from the motor to the tip.  S never
changes; p is found anew each step. A step never spans a change of the command.  The torque's jump at a
change of the command becomes a jump of the driven inertia's acceleration, which keeps the rule's second
order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from station.control.compensators import Compensator, commanded
from station.errors import UsageError
from station.model.assembly import Assembly, assemble
from station.model.beam import element_stiffness
from station.model.simulate import limit_of
from station.rig import Rig
from station.runs.run import Run


def lumped_assembly(rig: Rig, lumps: int) -> Assembly:
    """The rig with its beam as a chain of ``lumps`` rigid pieces; same coordinates as ``assemble``."""
    if rig.beam is None:
        return assemble(rig)
    if any(factor != 1.0 for factor in rig.beam.profile):
        raise UsageError(f"{rig.name}: beam.rigidity_1 to 3 are for finite elements; a chain of lumps is uniform")
    beam = rig.beam.model_copy(update={"elements": lumps})
    parts = assemble(rig.model_copy(update={"beam": beam}))
    h = beam.length / lumps
    masses = np.zeros(parts.size)
    masses[parts.motor] += rig.motor.inertia
    masses[parts.base] += 0.0 if rig.base is None else rig.base.inertia
    masses[parts.root] += beam.mass_per_length * h**3 / 24.0
    masses[parts.nodes] += beam.mass_per_length * h
    masses[parts.nodes + 1] += beam.mass_per_length * h**3 / 12.0
    masses[parts.tip] -= beam.mass_per_length * h / 2.0
    masses[parts.tip + 1] -= beam.mass_per_length * h**3 / 24.0
    if rig.tip is not None:
        masses[parts.tip] += rig.tip.mass
        masses[parts.tip + 1] += rig.tip.inertia
    return replace(parts, mass=np.diag(masses))


@dataclass
class DiscreteChain:
    """A rig that is stepped by the discrete-time transfer matrix method.

    ``displacement``, ``velocity``, ``acceleration``: arrays in the order of ``assemble`` (SI units).
    """

    rig: Rig
    lumps: int
    dt: float

    def __post_init__(self) -> None:
        self.parts = lumped_assembly(self.rig, self.lumps)
        self.displacement, self.velocity, self.acceleration = (np.zeros(self.parts.size) for _ in range(3))
        self._torque = 0.0
        rig, mass = self.rig, np.diag(self.parts.mass).copy()
        a, d = 4.0 / self.dt**2, 2.0 / self.dt
        lumps = self.lumps if rig.beam is not None else 0
        element = np.zeros((4, 4)) if rig.beam is None else element_stiffness(
            rig.beam.flexural_rigidity, rig.beam.length / self.lumps)
        damping = 0.0 if rig.beam is None else rig.beam.damping
        # From the last lump to the root.  With x the displacement of a lump and y that of the lump before it,
        # x = offset - gains y, and the load on the piece between them is ``impedance`` y + history.
        first = self.parts.size - 2 * lumps
        inverses, gains = np.zeros((lumps, 2, 2)), np.zeros((lumps, 2, 2))
        stiff = element * (1.0 + damping * d)
        impedance = np.zeros((2, 2))
        for i in range(lumps - 1, -1, -1):
            at = first + 2 * i
            inverses[i] = np.linalg.inv(stiff[2:, 2:] + np.diag(a * mass[at:at + 2]) + impedance)
            gains[i] = inverses[i] @ stiff[2:, :2]
            impedance = stiff[:2, :2] - stiff[:2, 2:] @ gains[i]
        joints = [joint for joint in (rig.drive, rig.clamp) if joint is not None]
        self._stepper = (a, d, mass, first, damping * element, inverses, gains, stiff,
                         np.array([j.stiffness for j in joints]), np.array([j.damping for j in joints]),
                         rig.motor.damping, impedance[1, 1])

    def advance(self, command: float, steps: int = 1) -> None:
        """Hold ``command`` (counts) for ``steps`` steps of dt."""
        torque = self.rig.motor.gain * command
        self.acceleration[0] += (torque - self._torque) / self.parts.mass[0, 0]
        self._torque = torque
        _advance(self.displacement, self.velocity, self.acceleration, torque, steps, *self._stepper)

    def readings(self) -> tuple[float, float]:
        """Encoder and accelerometer, counts, not rounded; 0 where there is no accelerometer."""
        accel = 0.0
        if self.rig.accelerometer is not None and self.parts.tip is not None:
            accel = self.rig.accelerometer.gain * float(self.acceleration[self.parts.tip])
        return float(self.displacement[self.parts.base]) / self.rig.angle_per_count, accel


@njit(cache=True, nogil=True)
def _advance(x, v, acc, torque, steps, a, d, mass, first, viscous, inverses, gains, stiff, joint_stiffness,
             joint_damping, motor_damping, beam_impedance):  # pragma: no cover (compiled)
    """Step in place.  ``first``: index of the first lump's deflection; before it stand the rotations."""
    size, lumps = x.size, inverses.shape[0]
    e, b = np.empty(size), np.empty(size)
    offsets = np.zeros((lumps, 2))
    impedance, offset = np.empty(first), np.empty(first)
    for _ in range(steps):
        for i in range(size):
            e[i] = -d * x[i] - v[i]
            b[i] = -a * x[i] - 2.0 * d * v[i] - acc[i]
        # Tip to root: displacement of lump i = offsets[i] - gains[i] (displacement of lump i - 1).
        load0 = load1 = 0.0     # history on the lump's right
        for i in range(lumps - 1, -1, -1):
            at = first + 2 * i
            left0, left1 = (e[at - 2], e[at - 1]) if i > 0 else (0.0, e[first - 1])
            right0, right1 = e[at], e[at + 1]
            r0 = -load0 - mass[at] * b[at] - (viscous[2, 0] * left0 + viscous[2, 1] * left1
                                              + viscous[2, 2] * right0 + viscous[2, 3] * right1)
            r1 = -load1 - mass[at + 1] * b[at + 1] - (viscous[3, 0] * left0 + viscous[3, 1] * left1
                                                      + viscous[3, 2] * right0 + viscous[3, 3] * right1)
            offsets[i, 0] = inverses[i, 0, 0] * r0 + inverses[i, 0, 1] * r1
            offsets[i, 1] = inverses[i, 1, 0] * r0 + inverses[i, 1, 1] * r1
            load0 = (stiff[0, 2] * offsets[i, 0] + stiff[0, 3] * offsets[i, 1] + viscous[0, 0] * left0
                     + viscous[0, 1] * left1 + viscous[0, 2] * right0 + viscous[0, 3] * right1)
            load1 = (stiff[1, 2] * offsets[i, 0] + stiff[1, 3] * offsets[i, 1] + viscous[1, 0] * left0
                     + viscous[1, 1] * left1 + viscous[1, 2] * right0 + viscous[1, 3] * right1)
        # Root to motor: torque on rotation i from its left = impedance[i] x[i] + offset[i].
        stiffness, load = beam_impedance, load1
        for i in range(first - 1, -1, -1):
            damping = motor_damping if i == 0 else 0.0
            stiffness += mass[i] * a + damping * d
            load += mass[i] * b[i] + damping * e[i]
            impedance[i], offset[i] = stiffness, load
            if i > 0:
                k = joint_stiffness[i - 1] + joint_damping[i - 1] * d
                history = joint_damping[i - 1] * (e[i - 1] - e[i])
                # k (x[i-1] - x[i]) + history = stiffness x[i] + load
                load = k / (k + stiffness) * load + stiffness / (k + stiffness) * history
                stiffness = k * stiffness / (k + stiffness)
        # Motor to root, root to tip.
        new = (torque - offset[0]) / impedance[0]
        for i in range(first):
            if i > 0:
                k = joint_stiffness[i - 1] + joint_damping[i - 1] * d
                history = joint_damping[i - 1] * (e[i - 1] - e[i])
                new = (k * new + history - offset[i]) / (k + impedance[i])
            x[i] = new
        before0, before1 = 0.0, x[first - 1]
        for i in range(lumps):
            at = first + 2 * i
            x[at] = offsets[i, 0] - gains[i, 0, 0] * before0 - gains[i, 0, 1] * before1
            x[at + 1] = offsets[i, 1] - gains[i, 1, 0] * before0 - gains[i, 1, 1] * before1
            before0, before1 = x[at], x[at + 1]
        for i in range(size):
            v[i] = d * x[i] + e[i]
            acc[i] = a * x[i] + b[i]


@dataclass(frozen=True)
class ChainRun:
    """Columns of a run stepped by the chain; counts, one row for each of the run's."""

    command: np.ndarray
    encoder: np.ndarray
    accel: np.ndarray


def run_chain(rig: Rig, run: Run, lumps: int, steps_per_sample: int = 1, rounding: bool = False) -> ChainRun:
    """Repeat ``run`` on the chain: its reference through its own compensator, or its command where it is
    open or its compensator is not known.

    At tick i the sensors are read, then row i's command acts for one period; with command_row = -k it comes
    from row i's reference and row i - k's readings.  From rest at angle 0.  ``rounding`` rounds readings
    and command half up.
    """
    chain = DiscreteChain(rig, lumps, rig.period / steps_per_sample)
    spec = {"kind": "open"} if commanded(run.metadata.controller) else run.metadata.controller
    compensator = Compensator.from_spec(spec, rig.sample_rate, limit_of(rig, run.metadata))
    delay = -run.metadata.command_row
    rows = len(run.t)
    command, encoder, accel = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for i in range(rows):
        encoder[i], accel[i] = chain.readings()
        if rounding:
            encoder[i], accel[i] = np.floor(encoder[i] + 0.5), np.floor(accel[i] + 0.5)
        if compensator.open_loop:
            command[i] = compensator.step(run.command[i], 0.0, 0.0)
        else:
            seen = (encoder[i - delay], accel[i - delay]) if i >= delay else (0.0, 0.0)
            command[i] = compensator.step(run.reference[i], *seen)
        if rounding:
            command[i] = np.floor(command[i] + 0.5)
        chain.advance(command[i], steps_per_sample)
    return ChainRun(command, encoder, accel)
