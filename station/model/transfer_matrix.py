"""The rig's frequency response by the transfer matrix method: a continuous beam, no discretisation.

Along the beam the state z = [w, theta, m, q] (deflection, slope, EI w'', EI w''') obeys

    dz/dx = [theta, m / EI, q, -mu s^2 w],    EI = flexural_rigidity (1 + damping s),

so that a piece of length l carries z by T = exp(A l), whose entries are the series

    c_k = l^k / k! + l^(k+4) b / (k+4)! + ...,    b = -mu s^2 / EI,    k = 0 .. 3

(the Krylov-Duncan functions).  A product of such matrices loses all its digits to exp(2 beta L) at high
frequency. The Riccati form of the method (Horner and Pilkey, J. Mech. Design 100, 1978) does not: it
carries the 2 x 2 relation [m, q] = S [w, theta] from the tip to the root, piece by piece, each short enough
for its matrix to be benign.  At the root w = 0, which leaves one number: the beam's impedance -S[0, 1],
torque over rotation.  A rigidity that varies along the beam is taken in STEPS.  Clamp, base, drive and
motor then follow as impedances in a chain.  Where a part is missing, so is its step.

All functions take complex s (rad/s) of any shape; s = j omega gives the frequency response.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from station.model.beam import rigidity
from station.rig import Beam, Rig

PIECE = 1.0
"""Largest |beta| times length of one piece."""
STEPS = 128
"""Steps of a beam whose rigidity varies along it."""
TERMS = 6
"""Terms of each series: the first one left out is below |beta l|^24 / 24! = 2e-24."""


@dataclass(frozen=True)
class ChainResponse:
    """What one newton metre at the motor does; arrays of the shape of s."""

    base: np.ndarray
    """Rotation of the base, rad per N m."""
    tip: np.ndarray | None
    """Acceleration of the sensor in the inertial frame, m/s^2 per N m."""
    characteristic: np.ndarray
    """An entire function of s, zero at the poles of the rig and nowhere else."""


def piece_matrix(beam: Beam, s: np.ndarray, length: float) -> np.ndarray:
    """Transfer matrices (..., 4, 4) of a piece of ``length`` m: z(right) = T z(left)."""
    rigidity = beam.flexural_rigidity * (1.0 + beam.damping * s)
    b = -beam.mass_per_length * s**2 / rigidity
    c0, c1, c2, c3 = (sum(b**n * length ** (k + 4 * n) / math.factorial(k + 4 * n) for n in range(TERMS))
                      for k in range(4))
    matrix = np.array([
        [c0, c1, c2 / rigidity, c3 / rigidity],
        [b * c3, c0, c1 / rigidity, c2 / rigidity],
        [rigidity * b * c2, rigidity * b * c3, c0, c1],
        [rigidity * b * c1, rigidity * b * c2, b * c3, c0]])
    return np.moveaxis(matrix, (0, 1), (-2, -1))


def _carry(beam: Beam, s: np.ndarray, length: float,
           relation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Carry S over ``length`` m towards the root.

    Returns S at the left end, the matrix D (..., 2, 2) with [w, theta](right) = D [w, theta](left), and the
    product of the pivots' determinants.
    """
    top = beam.mass_per_length * float(np.max(np.abs(s))) ** 2
    lowest = beam.flexural_rigidity * float(np.min(np.abs(1.0 + beam.damping * s)))
    pieces = max(1, math.ceil((top / lowest) ** 0.25 * length / PIECE))
    t = piece_matrix(beam, s, length / pieces)
    dd, df, fd, ff = t[..., :2, :2], t[..., :2, 2:], t[..., 2:, :2], t[..., 2:, 2:]
    transfer = np.broadcast_to(np.eye(2, dtype=complex), relation.shape)
    determinants = np.ones(s.shape, dtype=complex)
    for _ in range(pieces):
        pivot = ff - relation @ df
        determinants = determinants * np.linalg.det(pivot)
        relation = np.linalg.solve(pivot, relation @ dd - fd)
        transfer = transfer @ (dd + df @ relation)
    return relation, transfer, determinants


def chain_response(rig: Rig, s: np.ndarray, overhang: float = 0.0) -> ChainResponse:
    """The whole rig at complex frequencies ``s``.

    ``overhang`` (m) is a length of beam beyond the sensor.  The rig ends at the sensor, so it is 0 but
    where the question is what such a piece would change.
    """
    s = np.asarray(s, dtype=complex)
    impedance = np.zeros(s.shape, dtype=complex)
    characteristic = np.ones(s.shape, dtype=complex)
    tip = None
    beam = rig.beam
    if beam is not None:
        relation = np.zeros((*s.shape, 2, 2), dtype=complex)
        if overhang > 0.0:
            relation, _, pivots = _carry(beam, s, overhang, relation)
            characteristic = characteristic * pivots
        if rig.tip is not None:
            relation[..., 0, 1] -= rig.tip.inertia * s**2
            relation[..., 1, 0] += rig.tip.mass * s**2
        transfer: np.ndarray = np.eye(2, dtype=complex)
        shares = rigidity(STEPS, beam.profile) if any(factor != 1.0 for factor in beam.profile) else np.ones(1)
        for share in shares[::-1]:
            step = beam.model_copy(update={"flexural_rigidity": beam.flexural_rigidity * float(share)})
            relation, further, pivots = _carry(step, s, beam.length / len(shares), relation)
            characteristic, transfer = characteristic * pivots, transfer @ further
        impedance = -relation[..., 0, 1]
        tip = s**2 * transfer[..., 0, 1]
    root_per_base = np.ones(s.shape, dtype=complex)
    base_per_motor = np.ones(s.shape, dtype=complex)
    if rig.clamp is not None:
        joint = rig.clamp.stiffness + rig.clamp.damping * s
        root_per_base = joint / (joint + impedance)
        characteristic = characteristic * (joint + impedance)
        impedance = root_per_base * impedance
    if rig.base is not None:
        impedance = impedance + rig.base.inertia * s**2
    if rig.drive is not None:
        joint = rig.drive.stiffness + rig.drive.damping * s
        base_per_motor = joint / (joint + impedance)
        characteristic = characteristic * (joint + impedance)
        impedance = base_per_motor * impedance
    impedance = impedance + rig.motor.inertia * s**2 + rig.motor.damping * s
    base = base_per_motor / impedance
    if tip is not None:
        tip = tip * root_per_base * base
    return ChainResponse(base, tip, characteristic * impedance)


def undamped(rig: Rig) -> Rig:
    """The same rig without any damping."""
    parts = {"motor": rig.motor.model_copy(update={"damping": 0.0})}
    for table in ("drive", "clamp", "beam"):
        if getattr(rig, table) is not None:
            parts[table] = getattr(rig, table).model_copy(update={"damping": 0.0})
    return rig.model_copy(update=parts)


def natural_frequencies(rig: Rig, highest: float, overhang: float = 0.0, step: float = 0.25) -> np.ndarray:
    """Undamped natural frequencies in (0, ``highest``] Hz, from the sign changes of the characteristic
    function.

    Without damping that function is real on s = j omega, and a chain of parts has simple natural
    frequencies, so that each is a change of sign.  Two closer to each other than ``step`` (Hz) would be
    missed; then make it smaller. The rigid mode at 0 is not among them.
    """
    bare = undamped(rig)

    def value(hertz: np.ndarray) -> np.ndarray:
        """Characteristic function over -omega^2, the rigid mode's share."""
        omega = 2.0 * np.pi * np.asarray(hertz)
        return -chain_response(bare, 1j * omega, overhang).characteristic.real / omega**2

    grid = np.linspace(min(1e-3, 0.1 * step), highest, max(3, math.ceil(highest / step) + 1))
    signs = np.sign(value(grid))
    at = np.flatnonzero(signs[:-1] * signs[1:] < 0)
    return np.array([scipy.optimize.brentq(lambda f: float(value(np.array(f))), grid[i], grid[i + 1],
                                           xtol=1e-12, rtol=1e-13) for i in at])


def pole(rig: Rig, guess: complex, overhang: float = 0.0) -> complex:
    """The pole (rad/s) next to ``guess``: the characteristic function's zero, by the secant method."""
    scale = abs(complex(chain_response(rig, np.array(guess), overhang).characteristic))
    return complex(scipy.optimize.newton(
        lambda s: complex(chain_response(rig, np.array(s), overhang).characteristic) / scale,
        guess, x1=guess * (1.0 + 1e-5), tol=1e-12 * max(abs(guess), 1.0), maxiter=100))
