"""The thesis's model as it was run: its numbers, and the cause of what it blames on large matrices."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.measured import measured_log


@pytest.fixture(scope="module")
def script():
    path = Path(__file__).resolve().parents[2] / "scripts" / "thesis_model.py"
    spec = importlib.util.spec_from_file_location("thesis_model", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["thesis_model"] = module
    spec.loader.exec_module(module)
    return module


def test_four_elements_give_the_thesis_overshoots_and_pulse_peak(script):
    model = script.thesis_model(4)
    assert script.overshoot(model, "p", 50.0) == pytest.approx(38.20, abs=0.01)      # table 5.2
    assert script.overshoot(model, "lead", 100.0) == pytest.approx(18.85, abs=0.05)  # table 5.3
    assert script.respond(model, script.pulse()).max() == pytest.approx(118.0, abs=0.5)


def test_first_mode_drifts_with_elements_in_h_theta_and_stays_in_radians(script):
    assert script.thesis_model(1).first_mode() == pytest.approx(2.89, abs=0.005)
    assert script.thesis_model(10).first_mode() == pytest.approx(4.61, abs=0.005)
    for elements in (1, 2, 4, 10):
        assert script.model_of(script.unit_rig(elements)).first_mode() == pytest.approx(2.845, abs=0.005)


def test_sflr_unit_pulse_peaks_at_128_counts(script):
    assert script.respond(script.model_of(script.unit_rig(4)), script.pulse()).max() == pytest.approx(128.0, abs=0.5)


@pytest.mark.parametrize("elements", [1, 4, 10])
def test_the_thesis_program_is_the_consistent_model_with_the_motor_times_h_squared(script, elements):
    thesis = script.respond(script.thesis_model(elements), script.pulse())
    radians = script.respond(script.model_of(script.same_in_radians(elements)), script.pulse())
    np.testing.assert_allclose(thesis, radians, atol=1e-6)


def test_degradation_with_elements_vanishes_in_radians(script):
    rows = script.table([1, 4, 10])
    thesis, rig = ([row[f"{name} p"] for row in rows] for name in ("thesis", "rig"))
    assert np.all(np.diff(thesis) > 7.0), "each refinement makes the thesis's overshoot worse"
    assert np.ptp(rig) < 0.02


def test_broadcast_feedback_is_the_sum_of_all_states_and_leaves_an_offset(script):
    model = script.thesis_model(4)
    broadcast = script.broadcast_feedback(model)
    total = np.ones((1, len(model.b)))
    np.testing.assert_array_equal(broadcast.a, model.a - 2.0 * model.b[:, None] @ total)
    meant = script.proportional_feedback(model)
    final = [-float(m.c @ np.linalg.solve(m.a, m.b)) * 50.0 for m in (broadcast, meant)]
    assert final[1] == pytest.approx(50.0, rel=1e-6)
    assert final[0] > 40 * 50.0, "its stiffness is a small part of what was meant"


def test_broadcast_feedback_leaves_the_model_almost_open(script):
    for elements in (1, 4, 10):
        model = script.thesis_model(elements)
        broadcast, meant = script.broadcast_feedback(model), script.proportional_feedback(model)
        assert broadcast.first_mode() == pytest.approx(model.first_mode(), rel=0.05)
        assert meant.first_mode() < 0.75 * model.first_mode()
        assert np.linalg.eigvals(broadcast.a).real.max() < 0.0


def test_broadcast_feedback_ends_off_the_measured_angle(script):
    log = np.loadtxt(measured_log("p"))
    ends = [script.respond(script.broadcast_feedback(script.thesis_model(n)), log[:, 3])[-1] for n in (1, 4, 10)]
    assert all(abs(end - log[-1, 4]) > 5.0 for end in ends)
