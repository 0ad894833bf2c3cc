"""The modal form: of a rig near another one, to first order."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from station.model.assembly import assemble, state_matrix
from station.model.modal import JORDAN, ModalForm, apply, modal_form
from station.model.simulate import Model, build
from station.rig import Rig, load_rig
from tests.model.random_rigs import rigs

TICKS = 300


def responses(model: Model) -> np.ndarray:
    """(ticks, 2) angle (rad) and acceleration at the tip (m/s^2) after one count over the first period."""
    plan, z, found = model.plan, model.plan.held, []
    for _ in range(TICKS):
        found.append((plan.base_angle @ z, plan.tip_acceleration @ z))
        z = apply(plan.phi, z)
    return np.array(found)


def changed(rig: Rig, path: str, log: float) -> Rig:
    return rig.with_constants({path: rig.constants()[path] * np.exp(log)})


def first_order(rig: Rig, path: str, log: float) -> ModalForm | None:
    matrices = [state_matrix(assemble(one)) for one in (changed(rig, path, log), rig)]
    return modal_form(assemble(rig)).moved(matrices[0] - matrices[1])


@given(rigs(), st.data())
@settings(max_examples=25, deadline=None)
def test_a_rig_beside_another_responds_as_its_derivative_says(rig, data):
    """To 3 %, or where rounding leaves differences over so small a step fewer digits, three times as well as these."""
    path = data.draw(st.sampled_from(sorted(rig.constants())))
    assume(first_order(rig, path, 1e-5) is not None)
    here, other = build(rig, 0.0), changed(rig, path, 1e-5)
    up, down = (responses(build(changed(rig, path, log), 0.0)) for log in (1e-3, -1e-3))
    derivative = (up - down) / 2e-3
    found, afresh = ((responses(model) - responses(here)) / 1e-5
                     for model in (build(other, 0.0, beside=here), build(other, 0.0)))
    errors = [np.abs(one - derivative).max(axis=0) for one in (found, afresh)]
    assert np.all(errors[0] <= 0.03 * np.abs(derivative).max(axis=0) + 3.0 * errors[1])


def test_what_is_left_out_grows_with_the_square_of_the_change():
    rig = load_rig("sflr").remeshed()
    here = build(rig, 0.0)
    errors = []
    for log in (1e-4, 1e-3):
        other = changed(rig, "base.inertia", log)
        assert first_order(rig, "base.inertia", log) is not None
        errors.append(np.abs(responses(build(other, 0.0, beside=here)) - responses(build(other, 0.0))).max(axis=0))
    np.testing.assert_allclose(errors[1] / errors[0], 100.0, rtol=0.2)


@pytest.mark.parametrize(("path", "log"), [("beam.length", 1e-5), ("clamp.stiffness", 0.5)])
def test_a_change_that_is_not_small_has_no_first_order(path, log):
    rig = load_rig("sflr").remeshed()
    assert first_order(rig, path, log) is None
    np.testing.assert_allclose(responses(build(changed(rig, path, log), 0.0, beside=build(rig, 0.0))),
                               responses(build(changed(rig, path, log), 0.0)), atol=1e-14)


def test_the_rigid_mode_stays_and_an_undamped_one_is_decoupled_afresh():
    rig = load_rig("sflr").remeshed()
    moved = first_order(rig, "motor.inertia", 1e-4)
    assert moved is not None and np.sum(moved.eigenvalues == 0.0) == 1
    loose = rig.model_copy(update={"beam": None, "clamp": None, "tip": None}).with_constants({"motor.damping": 0.0})
    assert JORDAN in modal_form(assemble(loose)).kind
    assert first_order(loose, "motor.inertia", 1e-5) is None
