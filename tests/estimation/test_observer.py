"""Observers forget a wrong angle after their horizon, on rigs of every shape."""

from __future__ import annotations

import math

import numpy as np
import pytest

from station.estimation.observer import _finer, observers
from station.model.effects import effect_class
from station.model.simulate import build, initial_state
from station.model.stepper import advance, begin, sense
from station.rig import Rig
from tests.truth import RIGID_AXIS, SERVO, SFLR, TWO_MASS

RIGS = {"axis": RIGID_AXIS, "two-mass": TWO_MASS, "sflr": SFLR, "servo": SERVO}
HORIZONS = (0.05, 0.5)


def bare(shape: str) -> Rig:
    """The rig without effects, with the mesh of fits."""
    return Rig.model_validate(RIGS[shape]).with_effects([]).with_elements(8)


def errors_left(rig: Rig, horizon: float, noise: float) -> np.ndarray:
    """Encoder errors (n) of predictions of a rig at rest that begin a small angle away; the stepper, row by row."""
    (observer,) = observers(rig, noise, (horizon,))
    model = build(rig, 0.1, 1e-3)
    wrong, right = (initial_state(model, angle, 0.0) for angle in (1e-3, 0.0))
    gain, work = observer.correction(model).state, np.zeros((4, max(model.plan.port_joint.size, 1)))
    begin(model.plan, wrong)
    begin(model.plan, right)
    torque, found = 0.0, []
    for _ in range(math.ceil(12.0 * horizon / rig.period)):
        missed = sense(model.plan, right, 0.0, False)[0] - sense(model.plan, wrong, 0.0, False)[0]
        found.append(missed)
        wrong.z[:] += gain * missed
        torque = observer.decay * (torque + observer.torque * missed)
        advance(model.plan, wrong, 0.0, torque, work)
        advance(model.plan, right, 0.0, 0.0, work)
    return np.array(found)


@pytest.mark.parametrize("horizon", HORIZONS)
@pytest.mark.parametrize("shape", RIGS)
def test_a_wrong_angle_is_forgotten_after_the_horizon(shape: str, horizon: float) -> None:
    rig = bare(shape)
    errors = np.abs(errors_left(rig, horizon, 0.1))
    assert errors.sum() * rig.period / errors[0] == pytest.approx(horizon, rel=0.02)
    if (shape, horizon) != ("sflr", 0.05):          # there the arm rings on: no torque that quick damps its mode
        assert errors[-1] < 0.02 * errors[0]


def test_an_infinite_horizon_corrects_nothing() -> None:
    (observer,) = observers(bare("sflr"), 0.1, (math.inf,))
    assert not observer.state.any() and observer.torque == 0.0


@pytest.mark.parametrize("shape", RIGS)
def test_a_shorter_horizon_corrects_more(shape: str) -> None:
    quick, slow, whole = observers(bare(shape), 0.1, (0.05, 0.5, math.inf))
    assert quick.torque > slow.torque > whole.torque == 0.0
    assert quick.decay < slow.decay < 1.0


def test_effects_of_the_rig_do_not_change_its_observers() -> None:
    friction = effect_class("coulomb_friction")(at="motor", torque=0.01)
    plain, rough = (observers(rig, 0.1, HORIZONS) for rig in (bare("sflr"), bare("sflr").with_effects([friction])))
    for one, other in zip(plain, rough, strict=True):
        assert np.array_equal(one.state, other.state) and one.torque == other.torque


def test_a_noisier_encoder_does_not_change_how_long_an_error_is_remembered() -> None:
    rig = bare("axis")
    for noise in (0.0, 1.0):
        errors = np.abs(errors_left(rig, 0.05, noise))
        assert errors.sum() * rig.period / errors[0] == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize("elements", [8, 16, 13])
def test_another_mesh_is_corrected_by_the_same_shape(elements: int) -> None:
    """What a unit error moves, seen where both meshes have nodes: motor, base, clamp's rotation and tip."""
    rig = bare("sflr")
    (observer,) = observers(rig, 0.1, (0.05,))
    one, other = (build(r, 0.0, 1e-3) for r in (rig, rig.with_elements(elements)))
    seen = [[m.assembly.motor, m.assembly.base, m.assembly.root, m.assembly.tip] for m in (one, other)]
    moved = [(m.form.basis @ observer.correction(m).state)[at] for m, at in zip((one, other), seen, strict=True)]
    assert moved[1] == pytest.approx(moved[0], rel=1e-6)


def test_a_rig_of_another_length_is_corrected_without_bending_it_more() -> None:
    """Deflections are shares of the length: of a beam half as long the tip is moved half as far."""
    rig = bare("sflr")
    (observer,) = observers(rig, 0.1, (0.05,))
    short = rig.with_constants({"beam.length": 0.5 * rig.constants()["beam.length"]})
    tips, roots = [], []
    for model in (build(rig, 0.0, 1e-3), build(short, 0.0, 1e-3)):
        moved = model.form.basis @ observer.correction(model).state
        tips.append(moved[model.assembly.tip])
        roots.append(moved[model.assembly.root])
    assert tips[1] == pytest.approx(0.5 * tips[0], rel=1e-6) and roots[1] == pytest.approx(roots[0], rel=1e-6)


@pytest.mark.parametrize(("elements", "wanted"), [(4, 8), (8, 16), (3, 7), (8, 8)])
def test_a_cubic_deflection_is_carried_to_another_mesh_exactly_where_the_elements_hold_it(elements: int,
                                                                                        wanted: int) -> None:
    def nodal(count: int) -> np.ndarray:
        x = np.arange(count + 1) / count
        both = np.column_stack([x - 2.0 * x**2 + 0.7 * x**3, 1.0 - 4.0 * x + 2.1 * x**2])
        return both.ravel()[1:]
    assert _finer(elements, wanted) @ nodal(elements) == pytest.approx(nodal(wanted), abs=1e-12)
