"""The continuous beam by transfer matrices against finite elements and against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings

from station.model.linear import natural_frequencies, state_space
from station.model.transfer_matrix import chain_response, piece_matrix, pole
from station.model.transfer_matrix import natural_frequencies as continuous_frequencies
from station.rig import Rig, load_rig
from tests.model.random_rigs import rigs

L2 = 0.00714375
"""Beam beyond the laboratory rig's sensor, m."""


def with_elements(rig: Rig, elements: int) -> Rig:
    return rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": elements})})


def decibel_error(rig: Rig, hertz: np.ndarray) -> np.ndarray:
    """Finite elements over transfer matrices, dB, outputs by frequencies."""
    response, torque = chain_response(rig, 2j * np.pi * hertz), rig.motor.gain
    exact = [response.base * torque / rig.angle_per_count]
    if response.tip is not None:
        exact.append(response.tip * torque * rig.accelerometer.gain)
    found = state_space(rig)(2j * np.pi * hertz, squeeze=False)[:, 0, :]
    return np.abs(20.0 * np.log10(np.abs(found / np.array(exact))))


@pytest.mark.parametrize("name", ["sflr", "sflr-unit"])
def test_finite_elements_meet_it_in_natural_frequency_and_magnitude(name):
    rig = with_elements(load_rig(name), 10)
    exact = continuous_frequencies(rig, 100.0)
    assert len(exact) == 4
    np.testing.assert_allclose(natural_frequencies(rig)[1:5], exact, rtol=1e-3)
    assert decibel_error(rig, np.geomspace(0.05, 100.0, 2000)).max() < 0.1     # zeros included


def test_a_rigidity_that_varies_along_the_beam_is_the_same_in_both():
    rig = with_elements(load_rig("sflr"), 40)
    beam = rig.beam.model_copy(update={"rigidity_1": 1.2, "rigidity_2": 0.9, "rigidity_3": 1.1})
    uneven = rig.model_copy(update={"beam": beam})
    found, exact = natural_frequencies(uneven)[1:5], continuous_frequencies(uneven, 100.0)
    np.testing.assert_allclose(found, exact, rtol=1e-3)
    assert np.abs(exact / continuous_frequencies(rig, 100.0) - 1.0).max() > 0.02
    assert decibel_error(uneven, np.geomspace(0.05, 40.0, 150)).max() < 0.1


def test_error_against_it_falls_with_the_fourth_power_of_element_length():
    rig = load_rig("sflr")
    exact = continuous_frequencies(rig, 100.0)[3]
    counts = np.array([8, 12, 16])
    errors = np.array([natural_frequencies(with_elements(rig, n))[4] / exact - 1.0 for n in counts])
    np.testing.assert_allclose(-np.diff(np.log(errors)) / np.diff(np.log(counts)), 4.0, atol=0.1)


@given(rigs(most_elements=1))
@settings(max_examples=12, deadline=None)
def test_any_rig_with_parts_missing_agrees_away_from_its_zeros(rig):
    if rig.beam is None:
        hertz = np.geomspace(0.1, 100.0, 30)
    else:
        # Up to half the frequency at which 24 elements resolve a half wave with fewer than eight of them.
        wave = np.sqrt(rig.beam.flexural_rigidity / rig.beam.mass_per_length) / rig.beam.length**2
        hertz = np.geomspace(0.1, min(100.0, 60.0 * wave / (2.0 * np.pi)), 30)
        rig = with_elements(rig, 24)
    error = decibel_error(rig, hertz)
    assert np.quantile(error, 0.9) < 0.1
    assert np.median(error) < 0.01


def test_damped_poles_are_those_of_finite_elements():
    rig = with_elements(load_rig("sflr-unit"), 30)
    poles = np.linalg.eigvals(state_space(rig).A)
    poles = poles[(poles.imag > 0) & (np.abs(poles) < 700)]
    assert len(poles) == 3
    for found in poles:
        assert abs(pole(rig, found * 1.02) - found) < 1e-4 * abs(found)
    first = min(poles, key=abs)
    assert abs(first) / (2 * np.pi) == pytest.approx(2.84, abs=0.005)


def test_piece_is_the_static_beam_at_zero_frequency():
    beam = load_rig("sflr").beam
    length, rigidity = 0.2, beam.flexural_rigidity
    wanted = np.array([[1, length, length**2 / 2 / rigidity, length**3 / 6 / rigidity],
                       [0, 1, length / rigidity, length**2 / 2 / rigidity], [0, 0, 1, length], [0, 0, 0, 1]])
    np.testing.assert_allclose(piece_matrix(beam, np.array(0j), length), wanted, rtol=1e-14)


def test_pieces_multiply_to_the_whole():
    beam, s = load_rig("sflr").beam, np.array([3.0 + 40.0j, 200.0j])
    half, whole = piece_matrix(beam, s, 0.05), piece_matrix(beam, s, 0.1)
    np.testing.assert_allclose(half @ half, whole, rtol=1e-10)


def test_high_frequency_loses_no_digits():
    # At 20 kHz beta L = 100: a plain product of transfer matrices would lose 10^87.  The beam then answers at
    # its pinned root as an infinite one, w = exp(-beta x) - exp(-j beta x): torque over slope EI beta (1 + j).
    rig, s = load_rig("sflr"), 2j * np.pi * 2e4
    response = chain_response(rig, np.array([s]))
    rigidity = rig.beam.flexural_rigidity * (1.0 + rig.beam.damping * s)
    root = rigidity * (-rig.beam.mass_per_length * s**2 / rigidity) ** 0.25 * (1.0 + 1.0j)
    clamp = rig.clamp.stiffness + rig.clamp.damping * s
    drive = rig.drive.stiffness + rig.drive.damping * s
    behind = clamp * root / (clamp + root) + rig.base.inertia * s**2
    motor = rig.motor.inertia * s**2 + rig.motor.damping * s + drive * behind / (drive + behind)
    assert complex(response.base[0]) == pytest.approx(drive / (drive + behind) / motor, rel=1e-9)


def test_the_last_piece_beyond_the_sensor_lowers_every_mode_a_little():
    rig = load_rig("sflr")
    without, with_it = (continuous_frequencies(rig, 100.0, overhang) for overhang in (0.0, L2))
    assert np.all(with_it < without)
    np.testing.assert_allclose(with_it / without, 1.0, atol=0.02)
    assert np.max(1.0 - with_it / without) > 1e-3
