"""Closed loop in state space, poles, zeros and modes of the rig."""

import control
import numpy as np
import pytest
from hypothesis import given, settings

from station.control.design import modes, proportional_loop, transfer_function
from station.errors import UsageError
from station.model.linear import natural_frequencies, sampled, state_space
from station.model.simulate import simulate
from station.model.transfer_matrix import undamped
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
from tests.model.random_rigs import rigs


def step_run(gain: float, rows: int = 600) -> Run:
    reference = np.where(np.arange(rows) >= 10, 50.0, 0.0)
    zero = np.zeros(rows)
    return Run("step", np.arange(rows) / 500.0, reference, zero, zero, zero,
               RunMetadata(controller={"kind": "p", "gain": gain}))


def test_proportional_loop_is_the_simulated_loop_with_the_same_hold():
    rig, run = load_rig("sflr").meshed(), step_run(2.0)
    loop = proportional_loop(sampled(rig), 2.0)
    found = control.forced_response(loop, run.t, run.reference).outputs
    wanted = simulate(rig, run, rounding=False, start_angle=0.0)
    assert np.abs(wanted.command).max() < rig.amplifier.limit
    np.testing.assert_allclose(found[0], wanted.encoder, atol=0.01)
    np.testing.assert_allclose(found[1], wanted.accel, atol=0.02)
    assert loop.dcgain()[0, 0] == pytest.approx(1.0, rel=1e-6)


def test_continuous_loop_is_the_limit_of_a_fast_hold():
    rig = load_rig("sflr")
    fast = rig.model_copy(update={"sample_rate": 1e5})
    slow_pole = min((p for p in proportional_loop(state_space(rig), 2.0).poles() if p.imag > 1), key=abs)
    held = np.log(proportional_loop(sampled(fast), 2.0).poles().astype(complex)) * fast.sample_rate
    assert np.abs(held - slow_pole).min() < 1e-3 * abs(slow_pole)


def test_an_output_that_jumps_with_the_command_closes_no_loop():
    rig = load_rig("sflr").model_copy(update={"drive": None, "clamp": None})
    with pytest.raises(UsageError, match="jumps with the command"):
        proportional_loop(state_space(rig), 1.0, "accel")
    with pytest.raises(UsageError, match="this plant has encoder, accel"):
        proportional_loop(state_space(rig), 1.0, "strain")


@pytest.mark.parametrize("output", [0, 1])
def test_factors_give_the_plant_back(output):
    plant = state_space(load_rig("sflr"))
    factors = transfer_function(plant, plant.output_labels[output])
    s = 2j * np.pi * np.geomspace(0.05, 200.0, 300)
    np.testing.assert_allclose(factors(s), plant(s)[output, 0], rtol=1e-6)


def test_tip_has_zeros_in_the_right_half_plane_and_base_has_none():
    plant = state_space(load_rig("sflr"))
    tip, base = (transfer_function(plant, name, below=600.0) for name in ("accel", "encoder"))
    assert base.nonminimum_phase.size == 0
    assert tip.nonminimum_phase[0] == pytest.approx(81.2, abs=0.1)
    # A pair left and right, as a beam that is driven at the root and read at the tip has.
    assert np.min(np.abs(tip.zeros + tip.nonminimum_phase[0])) < 1.0


def test_reduced_factors_hold_where_the_frequency_is_low():
    plant = state_space(load_rig("sflr"))
    reduced = transfer_function(plant, "encoder", below=500.0)
    assert len(reduced.poles) < plant.nstates / 2
    s = 2j * np.pi * np.geomspace(0.1, 10.0, 50)
    np.testing.assert_allclose(np.abs(reduced(s) / plant(s)[0, 0]), 1.0, atol=0.01)


@given(rigs())
@settings(max_examples=15, deadline=None)
def test_residues_of_all_modes_sum_to_the_transfer_function(rig):
    plant = state_space(rig)
    found = modes(plant)
    s = 2j * np.pi * np.array([0.37, 3.3, 21.0])
    total = np.zeros(3, dtype=complex)
    for mode in found:
        residue = mode.residue["encoder"]
        total += residue / (s - mode.pole)
        if mode.pole.imag > 0.0:
            total += np.conj(residue) / (s - np.conj(mode.pole))
    wanted = np.array([complex(plant(x, squeeze=False)[0, 0]) for x in s])
    np.testing.assert_allclose(total, wanted, rtol=1e-4)
    assert all(0.0 <= mode.controllability <= 1.0 + 1e-9 for mode in found)
    assert all(mode.damping >= -1e-6 for mode in found)


def test_undamped_modes_are_the_natural_frequencies_without_damping():
    rig = undamped(load_rig("sflr"))
    found = [mode for mode in modes(state_space(rig)) if mode.frequency > 0.1]
    np.testing.assert_allclose([mode.frequency for mode in found], natural_frequencies(rig)[1:], rtol=1e-6)
    assert max(abs(mode.damping) for mode in found) < 1e-6


def test_a_mode_that_the_base_does_not_feel_is_unseen_and_out_of_reach():
    plant = state_space(load_rig("sflr"))
    aside = control.ss(np.array([[0.0, 1.0], [-900.0, -1.0]]), np.zeros((2, 1)), np.zeros((2, 2)), np.zeros((2, 1)))
    whole = control.ss(np.block([[plant.A, np.zeros((plant.nstates, 2))], [np.zeros((2, plant.nstates)), aside.A]]),
                       np.vstack([plant.B, aside.B]), np.hstack([plant.C, np.zeros((2, 2))]), plant.D,
                       outputs=plant.output_labels)
    lone = min(modes(whole), key=lambda mode: abs(abs(mode.pole) - 30.0))
    assert lone.controllability < 1e-9 and max(lone.observability.values()) < 1e-9
    others = [mode for mode in modes(whole) if 0.1 < mode.frequency < 60 and mode is not lone]
    assert min(mode.controllability for mode in others if abs(abs(mode.pole) - 30.0) > 1) > 1e-6
