"""Euler-Bernoulli beam elements: cubic Hermite shape functions, consistent mass.

With x = xi h along an element of length h and the nodal coordinates q = [y1, theta1, y2, theta2] (m, rad), the
deflection is y = N q with

    N1 = 1 - 3 xi^2 + 2 xi^3        N2 = h (xi - 2 xi^2 + xi^3)
    N3 = 3 xi^2 - 2 xi^3            N4 = h (-xi^2 + xi^3)

The kinetic energy 1/2 int mu y'^2 dx gives M = mu int N^T N dx, the strain energy 1/2 int EI (y_xx)^2 dx gives
K = EI int N_xx^T N_xx dx (Meirovitch, Fundamentals of Vibrations, 2001, ch. 9; there with h theta as coordinate:
a rotation in radians is used here throughout, so that every other part joins without a factor h).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from station.model.compiled import njit

REAL_ELEMENTS = 16
"""Elements, at least, of a beam that stands for a real one: a coarser mesh's error would look like physics."""


def element_mass(mass_per_length: float, h: float) -> np.ndarray:
    """Consistent mass matrix (4 x 4) of an element of length ``h`` m; mass_per_length in kg/m."""
    return mass_per_length * h / 420.0 * np.array([
        [156.0, 22.0 * h, 54.0, -13.0 * h],
        [22.0 * h, 4.0 * h**2, 13.0 * h, -3.0 * h**2],
        [54.0, 13.0 * h, 156.0, -22.0 * h],
        [-13.0 * h, -3.0 * h**2, -22.0 * h, 4.0 * h**2]])


def element_stiffness(flexural_rigidity: float, h: float) -> np.ndarray:
    """Stiffness matrix (4 x 4) of an element of length ``h`` m; flexural_rigidity EI in N m^2."""
    return flexural_rigidity / h**3 * np.array([
        [12.0, 6.0 * h, -12.0, 6.0 * h],
        [6.0 * h, 4.0 * h**2, -6.0 * h, 2.0 * h**2],
        [-12.0, -6.0 * h, 12.0, -6.0 * h],
        [6.0 * h, 2.0 * h**2, -6.0 * h, 4.0 * h**2]])


def element_strain(flexural_rigidity: float, h: float) -> np.ndarray:
    """Rows (2 x 4) whose squares over q sum to twice an element's strain energy, so that R^T R is its stiffness.

    Its curvature is a constant, of energy EI (theta2 - theta1)^2 / 2h, and one that changes sign along it, of energy
    3 EI (theta1 + theta2 - 2 (y2 - y1)/h)^2 / 2h (natural modes of Argyris, Recent Advances in Matrix Methods, 1964).
    """
    bend = np.array([[0.0, -1.0, 0.0, 1.0], [2.0 / h, 1.0, -2.0 / h, 1.0]])
    return np.sqrt(flexural_rigidity / h * np.array([[1.0], [3.0]])) * bend


def rigidity(elements: int, factors: Sequence[float]) -> np.ndarray:
    """(elements) rigidity in the middle of every element over the mean: product of factors ^ cos(k pi x/L)."""
    return _rigidity(elements, np.asarray(factors, dtype=float))


@njit(cache=True)
def _rigidity(elements, factors):
    shares = np.ones(elements)
    for i in range(elements):
        for k in range(factors.size):
            shares[i] *= factors[k] ** math.cos((k + 1) * math.pi * (i + 0.5) / elements)
    return shares


def beam_matrices(mass_per_length: float, flexural_rigidity: float, length: float,
                  elements: int, factors: Sequence[float] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Mass and stiffness (2n+2 x 2n+2) of a free beam, nodes [y0, theta0, ...]; ``factors``: see ``rigidity``."""
    h = length / elements
    return _joined(element_mass(mass_per_length, h), element_stiffness(flexural_rigidity, h),
                   _rigidity(elements, np.asarray(factors, dtype=float)))


@njit(cache=True)
def _joined(mass, stiffness, shares):
    size = 2 * shares.size + 2
    total_mass, total_stiffness = np.zeros((size, size)), np.zeros((size, size))
    for k in range(shares.size):
        for i in range(4):
            for j in range(4):
                total_mass[2 * k + i, 2 * k + j] += mass[i, j]
                total_stiffness[2 * k + i, 2 * k + j] += shares[k] * stiffness[i, j]
    return total_mass, total_stiffness
