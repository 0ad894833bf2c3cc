"""Observers forget a wrong angle after their horizon, on rigs of every shape."""

from __future__ import annotations

import math

import numpy as np
import pytest

from station.estimation.observer import observers
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
    gain, work = observer.modal(model), np.zeros((4, max(model.plan.port_joint.size, 1)))
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
