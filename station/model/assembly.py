"""The rig's equations of motion: M q'' + C q' + K q = F u.

q = [motor, base, beam nodes]; rotations in rad, beam deflections in m in the inertial frame (small rotations), the
beam root's translation fixed.  A joint of stiffness k and damping c between the rotations a and b adds k and c times
[[1, -1], [-1, 1]] to K and C.  Where a drive or a clamp is missing its two rotations are one coordinate, so that
inertias add.  The beam's damping is proportional to its stiffness: C += damping K_beam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.model.beam import beam_matrices, element_strain, rigidity
from station.model.compiled import njit
from station.rig import Rig


@dataclass(frozen=True)
class Assembly:
    """Matrices (n x n) and where things are; indices into q."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    rigid: np.ndarray
    """q of a unit rotation of the whole rig (n): the mode that no spring opposes."""
    motor: int
    base: int
    root: int | None
    tip: int | None
    """Index of the tip's translation."""
    nodes: np.ndarray
    """Indices of the nodes' translations from the second node to the tip (elements)."""

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.mass.shape[0]

    def unit(self, index: int) -> np.ndarray:
        """The vector (n) that picks one coordinate: a torque on it, or its rotation."""
        vector = np.zeros(self.size)
        vector[index] = 1.0
        return vector

    def rotation(self, at: str) -> np.ndarray:
        """The rotation (n) of a part (motor, base), or of a joint (drive, clamp): of its first side less that of its
        second; by virtual work also the generalised torque of one N m there."""
        if at == "clamp" and self.root is not None:
            return self.unit(self.base) - self.unit(self.root)
        if at == "drive":
            return self.unit(self.motor) - self.unit(self.base)
        return self.unit({"motor": self.motor, "base": self.base}[at])


def assemble(rig: Rig) -> Assembly:
    """Assemble the rig's mass, damping and stiffness matrices, SI units, rotations in rad."""
    motor = 0
    base = motor if rig.drive is None else 1
    beam = rig.beam
    if beam is None:
        size, root = base + 1, None
    else:
        root = base if rig.clamp is None else base + 1
        size = root + 1 + 2 * beam.elements
    inertias, nodes, tip = [(motor, rig.motor.inertia)], np.zeros(0, dtype=int), None
    if rig.base is not None:
        inertias.append((base, rig.base.inertia))
    joints = [(one, other, joint.stiffness, joint.damping)
              for joint, one, other in ((rig.drive, motor, base), (rig.clamp, base, root)) if joint is not None]
    beam_mass, beam_stiffness, beam_damping = np.zeros((1, 1)), np.zeros((1, 1)), 0.0
    rigid = np.zeros(size)
    rigid[: base + 1] = 1.0
    if beam is not None and root is not None:
        beam_mass, beam_stiffness = beam_matrices(beam.mass_per_length, beam.flexural_rigidity, beam.length,
                                                  beam.elements, beam.profile)
        beam_damping = beam.damping
        nodes = root + 1 + 2 * np.arange(beam.elements)
        tip = size - 2
        if rig.tip is not None:
            inertias += [(tip, rig.tip.mass), (tip + 1, rig.tip.inertia)]
        rigid[root] = 1.0
        rigid[nodes] = beam.length / beam.elements * np.arange(1, beam.elements + 1)
        rigid[nodes + 1] = 1.0
    mass, damping, stiffness = _joined(size, np.array(inertias), np.array(joints).reshape(-1, 4), beam_mass,
                                       beam_stiffness, beam_damping)
    damping[motor, motor] += rig.motor.damping
    return Assembly(mass, damping, stiffness, rigid, motor, base, root if beam is not None else None, tip, nodes)


@njit(cache=True)
def _joined(size, inertias, joints, beam_mass, beam_stiffness, beam_damping):
    """M, C and K of inertias (index, inertia), joints (index, index, stiffness, damping) and a free beam whose end is
    held, in the last coordinates."""
    mass, damping, stiffness = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    count = len(beam_mass) - 1
    at = size - count
    for i in range(count):
        for j in range(count):
            mass[at + i, at + j] = beam_mass[1 + i, 1 + j]
            stiffness[at + i, at + j] = beam_stiffness[1 + i, 1 + j]
            damping[at + i, at + j] = beam_damping * beam_stiffness[1 + i, 1 + j]
    for k in range(len(inertias)):
        i = int(inertias[k, 0])
        mass[i, i] += inertias[k, 1]
    for k in range(len(joints)):
        one, other = int(joints[k, 0]), int(joints[k, 1])
        for matrix, value in ((stiffness, joints[k, 2]), (damping, joints[k, 3])):
            matrix[one, one] += value
            matrix[other, other] += value
            matrix[one, other] -= value
            matrix[other, one] -= value
    return mass, damping, stiffness


def strain(rig: Rig) -> np.ndarray:
    """Rows R (n - 1 x n) with K = R^T R: what each joint and each mode of a beam element is deformed by, sqrt(N m).

    Every deformation is a difference of neighbours, so that R holds the soft modes to rounding, which K, where stiff
    elements swamp them, does not.
    """
    parts = assemble(rig)
    rows = []
    for at, joint in (("drive", rig.drive), ("clamp", rig.clamp)):
        if joint is not None:
            rows.append(np.sqrt(joint.stiffness) * parts.rotation(at))
    if rig.beam is not None:
        count = rig.beam.elements
        element = element_strain(rig.beam.flexural_rigidity, rig.beam.length / count)
        bent = np.zeros((2 * count, 2 * count + 2))
        shares = rigidity(count, rig.beam.profile)
        for i, share in enumerate(shares):
            bent[2 * i:2 * i + 2, 2 * i:2 * i + 4] = np.sqrt(share) * element
        beam = np.zeros((2 * count, parts.size))
        beam[:, parts.root:] = bent[:, 1:]
        rows.extend(beam)
    return np.array(rows).reshape(-1, parts.size)


def state_matrix(assembly: Assembly) -> np.ndarray:
    """A (2n x 2n) of x' = A x + B u, x = [q, q']: A = [[0, I], [-M^-1 K, -M^-1 C]]."""
    n = assembly.size
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:] = -np.linalg.solve(assembly.mass, np.concatenate([assembly.stiffness, assembly.damping], axis=1))
    return a


def axis_moment(assembly: Assembly, motor_damping: float) -> np.ndarray:
    """Row (2n) over [q, q'] of the torque that beam and clamp exert on a motor without a drive, N m."""
    viscous = assembly.damping[assembly.motor] - motor_damping * assembly.unit(assembly.motor)
    return -np.concatenate([assembly.stiffness[assembly.motor], viscous])


def torque_input(assembly: Assembly, torque: np.ndarray) -> np.ndarray:
    """B (2n) = [0, M^-1 F] of a generalised torque F (n) of one N m."""
    return np.concatenate([np.zeros(assembly.size), np.linalg.solve(assembly.mass, torque)])
