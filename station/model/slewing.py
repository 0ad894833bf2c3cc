"""A slewing link in the form of Tokhi and Azad: rotation of the hub, and deflections seen from the turning
hub.

A point at distance x from the hub moves by y = x theta + w(x), w small and measured from the line that
turns with the hub.  In element n (from 1), x = (n - 1) l + s, and w = N(s) [w1, phi1, w2, phi2] with the
Hermite functions of ``beam``.  So y = [x, N] [theta, w1, phi1, w2, phi2], and the kinetic energy 1/2 int mu
y'^2 ds gives

    M = mu int [x, N]^T [x, N] ds

with the first row mu l / 420 [140 l^2 (3 n^2 - 3 n + 1), 21 l (10 n - 7), 7 l^2 (5 n - 3), 21 l (10 n - 3),
-7 l^2 (5 n - 2)] and the Hermite element's mass matrix below it,

while the strain energy knows nothing of theta: K is bordered with zeros.  (Azad, Tokhi, Mohamed, Mahil,
Poerwanto in Flexible Robot Manipulators, 2008; M. O. Tokhi and Z. Mohamed, 1999.)  The link is clamped to
the hub: w = phi = 0 there.  The payload is a point at the tip.  The rig in these coordinates has no drive
and no clamp; y and the slope theta + phi are the coordinates of ``assemble``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from station.errors import UsageError
from station.model.beam import element_mass, element_stiffness, rigidity
from station.rig import Rig


def slewing_element_mass(mass_per_length: float, length: float, number: int) -> np.ndarray:
    """Mass matrix (5 x 5) over [theta, w1, phi1, w2, phi2] of element ``number`` (from 1), ``length`` m."""
    n, h = number, length
    matrix = np.zeros((5, 5))
    matrix[0] = mass_per_length * h / 420.0 * np.array([
        140.0 * h**2 * (3 * n**2 - 3 * n + 1), 21.0 * h * (10 * n - 7), 7.0 * h**2 * (5 * n - 3),
        21.0 * h * (10 * n - 3), -7.0 * h**2 * (5 * n - 2)])
    matrix[1:, 0] = matrix[0, 1:]
    matrix[1:, 1:] = element_mass(mass_per_length, h)
    return matrix


def slewing_element_stiffness(flexural_rigidity: float, length: float) -> np.ndarray:
    """Stiffness matrix (5 x 5); turning the hub costs nothing."""
    matrix = np.zeros((5, 5))
    matrix[1:, 1:] = element_stiffness(flexural_rigidity, length)
    return matrix


def rayleigh(frequencies: tuple[float, float], ratios: tuple[float, float]) -> tuple[float, float]:
    """alpha (1/s) and beta (s) of damping alpha M + beta K that give two modes their damping ratios.

    A mode at omega has the ratio (alpha / omega + beta omega) / 2; ``frequencies`` in rad/s, both above 0.
    """
    one, two = frequencies
    if not 0.0 < one < two:
        raise UsageError(f"Rayleigh damping: two frequencies are wanted, 0 < one < two, not {one} and {two}")
    beta = 2.0 * (ratios[1] * two - ratios[0] * one) / (two**2 - one**2)
    return 2.0 * ratios[0] * one - beta * one**2, beta


@dataclass(frozen=True)
class SlewingLink:
    """Matrices (2 n + 1) over [theta, w_1, phi_1, ..., w_n, phi_n]; a hub torque acts on theta alone."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    to_inertial: np.ndarray
    """T with q = T a: from these coordinates to those of ``assemble``."""


def slewing_link(rig: Rig, ratios: tuple[float, float] | None = None) -> SlewingLink:
    """The link of a rig without drive and clamp; hub inertia is that of motor and base, payload that of the
    tip.

    The hub has the motor's damping.  The link has that of the beam, or, where two damping ratios are given,
    Rayleigh damping that gives them to its first two modes with the hub held (which is how they are
    measured).
    """
    if rig.beam is None or rig.drive is not None or rig.clamp is not None:
        raise UsageError(f"{rig.name}: a slewing link is a rig with a beam and without drive and clamp")
    beam, n = rig.beam, rig.beam.elements
    h = beam.length / n
    # With the hub's own w_0 and phi_0, dropped below.
    mass, stiffness = np.zeros((2 * n + 3, 2 * n + 3)), np.zeros((2 * n + 3, 2 * n + 3))
    for number, share in enumerate(rigidity(n, beam.profile), start=1):
        at = np.r_[0, 2 * number - 1:2 * number + 3]
        mass[np.ix_(at, at)] += slewing_element_mass(beam.mass_per_length, h, number)
        stiffness[np.ix_(at, at)] += slewing_element_stiffness(beam.flexural_rigidity * share, h)
    kept = np.r_[0, 3:2 * n + 3]
    mass, stiffness = mass[np.ix_(kept, kept)], stiffness[np.ix_(kept, kept)]
    mass[0, 0] += rig.motor.inertia + (0.0 if rig.base is None else rig.base.inertia)
    if rig.tip is not None:
        deflection, slope = np.zeros(2 * n + 1), np.zeros(2 * n + 1)
        deflection[[0, -2]] = beam.length, 1.0
        slope[[0, -1]] = 1.0, 1.0
        mass += rig.tip.mass * np.outer(deflection, deflection) + rig.tip.inertia * np.outer(slope, slope)
    damping = np.zeros_like(mass)
    if ratios is None:
        damping[1:, 1:] = beam.damping * stiffness[1:, 1:]
    else:
        held = stiffness[1:, 1:], mass[1:, 1:]
        one, two = np.sqrt(scipy.linalg.eigh(*held, eigvals_only=True, subset_by_index=[0, 1]))
        alpha, beta = rayleigh((float(one), float(two)), ratios)
        damping[1:, 1:] = alpha * mass[1:, 1:] + beta * stiffness[1:, 1:]
    damping[0, 0] = rig.motor.damping
    to_inertial = np.eye(2 * n + 1)
    to_inertial[1::2, 0] = h * np.arange(1, n + 1)
    to_inertial[2::2, 0] = 1.0
    return SlewingLink(mass, damping, stiffness, to_inertial)
