"""Tokhi and Azad's link against integrals, against the rig's own coordinates, and its Rayleigh damping."""

import numpy as np
import pytest
import scipy.linalg

from station.errors import UsageError
from station.model.assembly import assemble
from station.model.slewing import rayleigh, slewing_element_mass, slewing_element_stiffness, slewing_link
from station.rig import Rig, load_rig


def link_rig(elements: int = 6) -> Rig:
    rig = load_rig("sflr")
    beam = rig.beam.model_copy(update={"elements": elements, "damping": 2e-4})
    return rig.model_copy(update={"drive": None, "clamp": None, "beam": beam})


@pytest.mark.parametrize("number", [1, 2, 7])
def test_element_mass_is_the_integral_of_hub_rotation_and_shape_functions(number):
    h, mu = 0.21, 0.8
    nodes, weights = np.polynomial.legendre.leggauss(6)
    xi, weights = 0.5 * (nodes + 1.0), 0.5 * h * weights
    rows = np.array([(number - 1 + xi) * h, 1 - 3 * xi**2 + 2 * xi**3, h * (xi - 2 * xi**2 + xi**3),
                     3 * xi**2 - 2 * xi**3, h * (xi**3 - xi**2)])
    np.testing.assert_allclose(slewing_element_mass(mu, h, number), mu * (rows * weights) @ rows.T, rtol=1e-12)
    assert not slewing_element_stiffness(1.0, h)[0].any()


def test_link_is_the_rig_in_other_coordinates():
    rig = link_rig()
    link, parts = slewing_link(rig), assemble(rig)
    for own, station in ((link.mass, parts.mass), (link.damping, parts.damping), (link.stiffness, parts.stiffness)):
        np.testing.assert_allclose(own, link.to_inertial.T @ station @ link.to_inertial, rtol=1e-10,
                                   atol=1e-13 * np.abs(own).max())
    torque = parts.unit(parts.motor)
    np.testing.assert_array_equal(link.to_inertial.T @ torque, np.eye(len(torque))[0])


def test_link_has_the_rig_frequencies_and_hub_response():
    rig = link_rig()
    link, parts = slewing_link(rig), assemble(rig)
    found, wanted = (np.sqrt(scipy.linalg.eigh(p.stiffness, p.mass, eigvals_only=True)[1:]) for p in (link, parts))
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    for s in (2j, 60j, 400j, 1500j):
        responses = [np.linalg.solve(p.mass * s**2 + p.damping * s + p.stiffness, np.eye(parts.size)[0])[0]
                     for p in (link, parts)]
        assert responses[0] == pytest.approx(responses[1], rel=1e-9)


def test_rigid_rotation_carries_hub_beam_and_payload_inertia():
    rig = link_rig()
    inertia = (rig.motor.inertia + rig.base.inertia + rig.beam.mass_per_length * rig.beam.length**3 / 3
               + rig.tip.mass * rig.beam.length**2 + rig.tip.inertia)
    assert slewing_link(rig).mass[0, 0] == pytest.approx(inertia, rel=1e-12)


@pytest.mark.parametrize("ratios", [(0.01, 0.02), (0.03, 0.005)])
def test_two_measured_damping_ratios_come_back_from_the_held_link(ratios):
    link = slewing_link(link_rig(), ratios)
    n = len(link.mass) - 1
    held = [m[1:, 1:] for m in (link.mass, link.damping, link.stiffness)]
    inverse = np.linalg.inv(held[0])
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ held[2], -inverse @ held[1]]])
    poles = np.linalg.eigvals(a)
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))][:2]
    np.testing.assert_allclose(-poles.real / np.abs(poles), ratios, rtol=1e-9)


def test_rayleigh_coefficients_follow_the_textbook_formula():
    alpha, beta = rayleigh((10.0, 40.0), (0.02, 0.05))
    assert 0.5 * (alpha / 10.0 + beta * 10.0) == pytest.approx(0.02)
    assert 0.5 * (alpha / 40.0 + beta * 40.0) == pytest.approx(0.05)
    with pytest.raises(UsageError, match="two frequencies"):
        rayleigh((40.0, 10.0), (0.02, 0.05))


def test_a_rig_with_a_drive_is_no_slewing_link():
    with pytest.raises(UsageError, match="without drive and clamp"):
        slewing_link(load_rig("sflr"))
