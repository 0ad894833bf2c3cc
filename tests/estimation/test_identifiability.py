"""States of fitted values, on covariances small enough to be worked out by hand."""

import math

import numpy as np
import pytest

from station.estimation.dataset import dataset
from station.estimation.identifiability import parameter_states, states, unseen, unseen_with_effects
from station.estimation.parameters import Hypothesis, parameters
from station.model.effects import effect_class
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
from tests.estimation.made import AXIS, predictions, runs_of

SFLR = load_rig("sflr")


def posterior(data: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Covariance from the data's information (n, n) and the prior's covariance."""
    return np.linalg.inv(data + np.linalg.inv(prior))


def test_what_the_data_say_far_beyond_the_prior_is_determined():
    prior = np.diag([0.01, 0.04])
    assert states(posterior(np.diag([1e4, 1e3]), prior), prior) == ["determined", "determined"]


def test_what_the_data_do_not_touch_is_not_excited():
    prior = np.diag([0.01, 0.04])
    found = states(posterior(np.diag([1e4, 5.0]), prior), prior)
    assert found == ["determined", "not_excited"]


@pytest.mark.parametrize("others, wanted", [(8, "not_excited"), (1, "traded_off")])
def test_one_number_shared_with_many_says_nothing_of_each(others, wanted):
    """With one other value it is a trade; spread over eight, none is its partner and the prior holds it."""
    direction = np.r_[1.0, np.full(others, 1.0 / math.sqrt(others))]
    prior = np.eye(others + 1)
    assert states(posterior(20.0 * np.outer(direction, direction), prior), prior)[0] == wanted


def test_the_border_is_where_data_and_prior_say_as_much():
    prior = np.diag([0.01, 0.01])
    assert states(posterior(np.diag([101.0, 99.0]), prior), prior) == ["determined", "not_excited"]


def test_values_of_which_only_the_ratio_shows_are_traded_off():
    """Six constants on one scale: each one's interval is a sixth of the prior's variance and none is the data's."""
    difference = np.eye(6) - np.full((6, 6), 1.0 / 6.0)
    prior = 0.01 * np.eye(6)
    covariance = posterior(1e6 * difference, prior)
    assert covariance[0, 0] == pytest.approx(0.01 / 6.0, rel=1e-3)
    found = states(covariance, prior)
    assert found == ["traded_off"] * 6


def test_two_that_show_as_one_are_traded_off_and_a_third_is_not():
    data = 1e6 * np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    prior = np.diag([0.01, 0.01, 0.02])
    assert states(posterior(data, prior), prior) == ["traded_off", "determined", "traded_off"]


def test_values_that_follow_each_other_are_traded_off_however_well_known():
    data = 1e8 * np.array([[1.0, -0.97], [-0.97, 1.0]])
    prior = np.diag([0.01, 0.01])
    found = states(posterior(data, prior), prior)
    assert found == ["traded_off", "traded_off"]
    assert states(posterior(1e8 * np.array([[1.0, -0.9], [-0.9, 1.0]]), prior), prior) == 2 * ["determined"]


def test_a_prior_that_ties_two_values_is_no_trade_where_the_data_see_each():
    prior = np.array([[1.01, 1.0], [1.0, 1.01]])
    assert states(posterior(np.diag([1e5, 1e5]), prior), prior) == ["determined", "determined"]


def test_a_value_at_a_bound_says_so_before_all_else():
    prior = np.diag([0.01, 0.01])
    assert states(posterior(np.diag([1e4, 0.1]), prior), prior, bounded=[0, 1]) == ["at_bound", "at_bound"]


def still(name: str) -> Run:
    """A run of which only the form matters."""
    rows = 100
    zero = np.zeros(rows)
    return Run(name, np.arange(rows) / 500.0, zero, zero, np.arange(rows, dtype=float), None,
               RunMetadata(controller={"kind": "open"}))


@pytest.fixture(scope="module")
def space():
    run = still("one")
    delay, ripple = effect_class("input_delay"), effect_class("torque_ripple")
    return parameters(dataset(AXIS, [run, run]),
                      Hypothesis(((delay, "amplifier"), (ripple, "motor")), ("motor.gain",)),
                      {("input_delay", "amplifier"): {"time": 0.003},
                       ("torque_ripple", "motor"): {"amplitude": 0.01, "cycles": 4.0, "phase": 3.0}})


def test_a_hypothesis_states_stand_in_the_order_of_its_parameters(space):
    """On a rigid axis gain, inertia and damping show as two ratios; all three are traded off, the delay is not."""
    n = len(space.paths)
    assert space.names()[:n] == ["motor.inertia", "motor.damping", "motor.gain"]
    assert space.names()[n] == "input_delay@amplifier.time"
    assert len(space.names()) == space.size
    information = np.zeros((space.size, space.size))
    ratios = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]]) @ space.root
    information[:n, :n] = 1e6 * ratios.T @ ratios
    information[n:, n:] = np.diag([1e5, 1e5, 1e5, 0.0] + [0.0] * space.zeros)
    covariance = np.linalg.inv(information + np.diag(space.precision))
    found = parameter_states(space, covariance, space.mean)
    assert found[:n] == ["traded_off"] * 3
    assert found[n: n + 4] == ["determined", "determined", "determined", "not_excited"]


def test_an_effect_at_its_bound_is_found_and_a_phase_has_none(space):
    x = space.mean.copy()
    n = len(space.paths)
    covariance = np.diag(1e-6 / space.precision)
    assert set(parameter_states(space, covariance, x)) == {"determined"}
    x[n] = math.log(5.0)
    x[n + 3] = math.pi
    found = parameter_states(space, covariance, x)
    assert found[n] == "at_bound" and found[n + 3] == "determined"
    x[0] = 100.0
    assert parameter_states(space, covariance, x)[0] == "at_bound"


@pytest.mark.parametrize("fixed, left", [((), 2), (("beam.mass_per_length",), 1),
                                         (("beam.mass_per_length", "beam.length"), 0)])
def test_no_data_show_the_units_of_torque_and_length_but_for_what_is_fixed(fixed, left):
    free = parameters(dataset(SFLR, [still("one")]), Hypothesis(), {}, fixed)
    found = unseen(free)
    assert found.shape == (len(free.paths), left)
    np.testing.assert_allclose(found.T @ found, np.eye(left), atol=1e-12)
    if left == 1:
        powers = dict(zip(free.paths, (free.root @ found)[:, 0], strict=True))
        assert powers["accelerometer.gain"] / powers["beam.length"] == pytest.approx(-1.0)
        assert powers["beam.flexural_rigidity"] / powers["beam.length"] == pytest.approx(4.0)


def test_a_torque_that_is_known_fixes_the_unit_of_torque():
    friction = effect_class("coulomb_friction")(at="motor", torque=0.05)
    curve = effect_class("gain_curve")(at="amplifier", exponent=0.1)
    left = [unseen(parameters(dataset(AXIS.with_effects(effects), [still("one")]), Hypothesis(), {})).shape[1]
            for effects in ([], [curve], [friction])]
    assert left == [1, 1, 0]


@pytest.mark.parametrize(("rig", "effects", "left"), [
    (AXIS, [("torque_ripple", "motor"), ("command_bias", "amplifier")], 1),
    (SFLR, [("coulomb_friction", "base"), ("cable_spring", "base"), ("backlash", "drive")], 2)])
def test_effects_move_with_the_units_that_their_sizes_bear(rig, effects, left):
    """Far along these directions no prediction moves, in any other the sensors see it."""
    predictor = predictions(rig, [still("one")] if rig is SFLR else runs_of(rig))
    classes = tuple((effect_class(name), at) for name, at in effects)
    sizes = {(cls.name, at): cls.guesses(rig, at)[0] for cls, at in classes}
    space = parameters(predictor.data, Hypothesis(classes), sizes)
    found, own = unseen_with_effects(space, space.mean), predictor.data.own
    assert found.shape == (space.size, left)
    first = np.concatenate(predictor.runs(space, space.mean, own), axis=1)

    def change(direction):
        return np.abs(np.concatenate(predictor.runs(space, space.mean + 0.3 * direction, own), axis=1) - first).max()
    assert all(change(direction) < 1e-8 for direction in found.T)
    other = np.random.default_rng(0).normal(size=space.size)
    assert change(other / np.linalg.norm(other)) > 0.01
