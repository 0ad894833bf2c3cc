"""Beam elements against theory: closed-form frequencies and shapes, the published table, and the order of accuracy."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from station.model import transfer_matrix
from station.model.assembly import assemble, strain
from station.model.beam import beam_matrices, element_mass, element_stiffness
from station.model.linear import natural_frequencies
from station.rig import load_rig

TABLE_3_1 = {
    1: ("17.54438", "70.08705"), 2: ("15.51421", "55.82281", "135.55951"), 5: ("15.42203", "50.08486", "105.21056"),
    10: ("15.41846", "49.97323", "104.32186"), 20: ("15.41822", "49.96540", "104.25254"),
    50: ("15.41821", "49.96488", "104.24782"), 100: ("15.41821", "49.96486", "104.24770")}
"""Thesis, table 3.1: pinned-free beam, mu = EI = L = 1.  Two elements, first mode: it prints 15.51451, a misprint."""


def pinned_free(elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Natural frequencies (the rigid mode left out) and shapes over [theta0, y1, theta1, ...]."""
    mass, stiffness = (m[1:, 1:] for m in beam_matrices(1.0, 1.0, 1.0, elements))
    squared, shapes = scipy.linalg.eigh(stiffness, mass)
    return np.sqrt(squared[1:]), shapes[:, 1:]


def roots(characteristic, starts):
    return np.array([scipy.optimize.brentq(characteristic, x - 0.3, x + 0.3, xtol=1e-14) for x in starts])


PINNED_FREE = roots(lambda x: np.tan(x) - np.tanh(x), [3.927, 7.069, 10.210])
"""beta L of the first three modes."""
CLAMPED_FREE = roots(lambda x: np.cos(x) * np.cosh(x) + 1.0, [1.875, 4.694, 7.855])


@pytest.mark.parametrize("elements", TABLE_3_1)
def test_published_table_is_met_to_its_last_digit(elements):
    found = [f"{frequency:.5f}" for frequency in pinned_free(elements)[0][:3]]
    assert tuple(found) == TABLE_3_1[elements]


def test_two_elements_printed_value_is_a_misprint():
    mass, stiffness = (m[1:, 1:] for m in beam_matrices(1.0, 1.0, 1.0, 2))
    below, above, printed = (np.linalg.det(stiffness - w**2 * mass) for w in (15.51420, 15.51422, 15.51451))
    assert below * above < 0.0, "det(K - w^2 M) has its zero between them"
    assert above * printed > 0.0
    assert abs(printed) > 10.0 * max(abs(below), abs(above))


def test_element_matrices_are_the_integrals_of_the_shape_functions():
    h, mu, ei = 0.3, 0.7, 1.9
    nodes, weights = np.polynomial.legendre.leggauss(6)
    xi, weights = 0.5 * (nodes + 1.0), 0.5 * h * weights
    shape = np.array([1 - 3 * xi**2 + 2 * xi**3, h * (xi - 2 * xi**2 + xi**3),
                      3 * xi**2 - 2 * xi**3, h * (xi**3 - xi**2)])
    curvature = np.array([-6 + 12 * xi, h * (-4 + 6 * xi), 6 - 12 * xi, h * (6 * xi - 2)]) / h**2
    np.testing.assert_allclose(element_mass(mu, h), mu * (shape * weights) @ shape.T, rtol=1e-12)
    np.testing.assert_allclose(element_stiffness(ei, h), ei * (curvature * weights) @ curvature.T, rtol=1e-12)


def test_clamped_free_frequencies_tend_to_the_closed_form():
    mass, stiffness = (m[2:, 2:] for m in beam_matrices(1.0, 1.0, 1.0, 40))
    found = np.sqrt(scipy.linalg.eigh(stiffness, mass, eigvals_only=True)[:3])
    np.testing.assert_allclose(found, CLAMPED_FREE**2, rtol=2e-6)
    assert np.all(found > CLAMPED_FREE**2 * (1 - 1e-9)), "Rayleigh-Ritz bounds from above"


@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_a_rigidity_that_varies_moves_frequencies_as_rayleighs_quotient_says(harmonic):
    """First order: 2 dw/w = int d(EI) phi''^2 / int EI phi''^2, phi the clamped-free beam's own shapes."""
    size, x = 1e-4, np.linspace(0.0, 1.0, 4001)
    factors = [1.0 + size if k == harmonic else 1.0 for k in (1, 2, 3)]
    found = []
    for profile in ((), factors):
        mass, stiffness = (m[2:, 2:] for m in beam_matrices(1.0, 1.0, 1.0, 60, profile))
        found.append(np.sqrt(scipy.linalg.eigh(stiffness, mass, eigvals_only=True)[:3]))
    for mode, beta in enumerate(CLAMPED_FREE):
        share = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))
        curvature = np.cosh(beta * x) + np.cos(beta * x) - share * (np.sinh(beta * x) + np.sin(beta * x))
        expected = np.sum(np.cos(harmonic * np.pi * x) * curvature**2) / np.sum(curvature**2)
        assert 2.0 * (found[1][mode] / found[0][mode] - 1.0) / size == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_mode_shapes_meet_the_analytic_eigenfunctions(mode):
    elements, beta = 20, PINNED_FREE[mode]
    x = np.arange(elements + 1) / elements
    analytic = np.sin(beta * x) + np.sin(beta) / np.sinh(beta) * np.sinh(beta * x)
    slope = beta * (np.cos(beta * x) + np.sin(beta) / np.sinh(beta) * np.cosh(beta * x))
    vector = pinned_free(elements)[1][:, mode]
    deflection, rotation = np.concatenate([[0.0], vector[1::2]]), vector[0::2]
    scale = deflection[-1] / analytic[-1]
    np.testing.assert_allclose(deflection / scale, analytic, atol=2e-5 * np.abs(analytic).max())
    np.testing.assert_allclose(rotation / scale, slope, atol=1e-4 * np.abs(slope).max())


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_frequency_error_falls_with_the_fourth_power_of_element_length(mode):
    counts = np.array([16, 24, 32])
    errors = np.array([pinned_free(n)[0][mode] / PINNED_FREE[mode] ** 2 - 1.0 for n in counts])
    orders = -np.diff(np.log(errors)) / np.diff(np.log(counts))
    np.testing.assert_allclose(orders, 4.0, atol=0.05)


@pytest.mark.parametrize("elements", [1, 7, 200])
@pytest.mark.parametrize("missing", [(), ("drive",), ("clamp",), ("drive", "clamp"),
                                     ("beam", "clamp", "tip", "accelerometer")], ids=str)
def test_squares_of_the_strains_are_the_stiffness(missing, elements):
    rig = load_rig("sflr").model_copy(update=dict.fromkeys(missing))
    if rig.beam is not None:
        rig = rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": elements})})
    rows, parts = strain(rig), assemble(rig)
    assert rows.shape == (parts.size - 1, parts.size)
    np.testing.assert_allclose(rows.T @ rows, parts.stiffness, rtol=0.0, atol=1e-14 * np.abs(parts.stiffness).max())
    np.testing.assert_allclose(rows @ parts.rigid, 0.0, atol=1e-12 * np.abs(rows).max())


@pytest.mark.parametrize("name", ["sflr", "sflr-unit"])
def test_low_frequencies_of_200_elements_are_those_of_the_exact_beam(name):
    """The transfer matrix has no elements; a share of 5e-10 would show."""
    rig = load_rig(name)
    fine = rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": 200})})
    np.testing.assert_allclose(natural_frequencies(fine)[1:4], transfer_matrix.natural_frequencies(rig, 20.0)[:3],
                               rtol=5e-10)


@pytest.mark.parametrize("name", ["sflr", "sflr-unit"])
def test_rig_frequencies_settle_from_above_up_to_200_elements(name):
    rig = load_rig(name)
    found = []
    for elements in (1, 2, 4, 8, 16, 32, 64, 200):
        beam = rig.beam.model_copy(update={"elements": elements})
        found.append(natural_frequencies(rig.model_copy(update={"beam": beam}))[1:4])
    found = np.array(found)
    exact = found[5]
    assert np.all(np.diff(found[:5], axis=0) < 0.0)
    np.testing.assert_allclose(found[5:], np.broadcast_to(exact, found[5:].shape), rtol=1e-5)
