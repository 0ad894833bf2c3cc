"""Where parameters stand, what they mean, and what is carried from one hypothesis to another."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from station.estimation.dataset import dataset
from station.estimation.parameters import FARTHEST, WIDE, Hypothesis, parameters
from station.model.effects import effect_class
from station.rig import Rig
from station.runs.run import Run
from tests.estimation.made import AXIS, run_of, runs_of
from tests.truth import TWO_MASS

DATA = dataset(AXIS, runs_of(AXIS))
FRICTION, DELAY, ROUND = (effect_class(n) for n in ("coulomb_friction", "input_delay", "encoder_eccentricity"))
TILT = effect_class("gravity_tilt")
CENTRES = {("coulomb_friction", "motor"): {"torque": 0.01}, ("input_delay", "amplifier"): {"time": 0.004},
           ("encoder_eccentricity", "encoder"): {"amplitude": 2.0, "phase": 0.5}}
ONE, BOTH = Hypothesis(((FRICTION, "motor"),)), Hypothesis(((FRICTION, "motor"), (DELAY, "amplifier")))


def test_the_prior_mean_is_the_nominal_rig_with_the_effects_at_their_centres() -> None:
    space = parameters(DATA, BOTH, CENTRES)
    rig = space.rig_at(space.mean)
    assert rig.constants() == pytest.approx(DATA.rig.constants())
    assert {(e.name, e.at): e.values() for e in rig.effects} == {
        key: pytest.approx(CENTRES[key]) for key in list(CENTRES)[:2]}
    assert len(space.names()) == space.size == len(space.precision)


def test_a_hypothesis_keeps_another_ones_values_and_begins_what_is_new_where_told() -> None:
    small, large = parameters(DATA, ONE, CENTRES), parameters(DATA, BOTH + Hypothesis((), ("motor.gain",)), CENTRES)
    x = small.mean + np.linspace(-0.7, 0.9, small.size)
    there = large.carried(small, x, {("input_delay", "amplifier"): {"time": 0.002}})
    np.testing.assert_allclose(large.logs(there), small.logs(x), atol=1e-12)
    assert large.values(there)["coulomb_friction", "motor"] == pytest.approx(
        small.values(x)["coulomb_friction", "motor"])
    assert large.values(there)["input_delay", "amplifier"] == pytest.approx({"time": 0.002})
    np.testing.assert_allclose(small.carried(large, there), x, atol=1e-10)


def test_a_constant_that_is_set_free_has_a_wide_prior_and_the_others_theirs() -> None:
    free = parameters(DATA, Hypothesis((), ("motor.gain",)), {})
    covariance = free.root @ free.root.T
    wanted = DATA.rig.log_covariance(list(free.paths))
    i = free.paths.index("motor.gain")
    wanted[i, i] += WIDE**2
    np.testing.assert_allclose(covariance, wanted, rtol=1e-10)


def test_no_constant_is_simulated_beyond_its_farthest() -> None:
    space = parameters(DATA, Hypothesis(), {})
    far = space.rig_at(np.linalg.solve(space.root, np.full(len(space.paths), 50.0))).constants()
    for path, value in DATA.rig.constants().items():
        assert far[path] == pytest.approx(value * math.exp(FARTHEST))


def test_sizes_stay_within_what_is_physical_on_the_rig() -> None:
    space = parameters(DATA, Hypothesis(((ROUND, "encoder"),)), CENTRES)
    x = space.mean.copy()
    first = space.parts["effects"].start
    x[first] = 60.0
    values = space.values(x)["encoder_eccentricity", "encoder"]
    assert values["amplitude"] == ROUND.largest(DATA.rig, "encoder")["amplitude"] < math.inf
    x[first + 1] = 0.5 + 2.0 * math.pi
    assert space.values(x)["encoder_eccentricity", "encoder"]["phase"] == pytest.approx(0.5)


def test_an_effect_that_the_rig_holds_moves_by_its_stated_uncertainty() -> None:
    rig = AXIS.with_effects([FRICTION(at="motor", torque=0.01)])
    unsure = rig.model_copy(update={"uncertainty": {**rig.uncertainty, "coulomb_friction.torque": 0.2}})
    data = dataset(unsure, runs_of(AXIS))
    space = parameters(data, Hypothesis(), {})
    assert len(space.held) == 1 and space.precision[space.parts["held"]] == pytest.approx([1.0])
    x = space.mean.copy()
    x[space.parts["held"]] = 1.0
    assert space.rig_at(x).effects[0].values()["torque"] == pytest.approx(0.01 * math.exp(0.2))
    assert not parameters(dataset(rig, runs_of(AXIS)), Hypothesis(), {}).held


def test_causes_are_taken_out_and_put_in() -> None:
    assert BOTH.without(("input_delay", "amplifier")).key == ONE.key
    assert (ONE + Hypothesis((), ("motor.gain",))).key == {("coulomb_friction", "motor"), ("parameter:motor.gain", "")}
    assert Hypothesis().label == "nothing"


def test_an_angle_of_an_effect_that_the_rig_holds_moves_by_radians() -> None:
    """A relative uncertainty of an angle would depend on where angles are counted from, and be none at 0."""
    pendulum = AXIS.with_effects([TILT(at="base", torque=0.02, angle=0.0)])
    unsure = pendulum.model_copy(update={"uncertainty": {**pendulum.uncertainty, "gravity_tilt.angle": 0.05}})
    space = parameters(dataset(unsure, runs_of(AXIS)), Hypothesis(), {})
    x = space.mean.copy()
    x[space.parts["held"]] = 2.0
    assert space.rig_at(x).effects[0].values() == pytest.approx({"torque": 0.02, "angle": 0.1})


def zeroed(*names: str | None) -> list[Run]:
    """Three runs whose encoders are zeroed as named."""
    return [replace(run, metadata=run.metadata.model_copy(update={"zero_id": name}))
            for run, name in zip(runs_of(AXIS), names, strict=True)]


@pytest.mark.parametrize(("stated", "supposed", "names", "wanted"), [
    (False, False, (None, None, None), [0.0, 0.0, 0.0]),
    (False, True, (None, None, None), [0.0, 1.0, 2.0]),
    (False, True, ("bench", "other", "bench"), [0.0, 1.0, 0.0]),
    (True, False, (None, None, None), [1.0, 2.0, 3.0]),
    (True, True, ("bench", "other", "bench"), [1.0, 2.0, 1.0])])
def test_a_zero_is_unknown_unless_absolute_angles_are_counted_from_it(stated, supposed, names, wanted) -> None:
    """An angle that the rig file says is known, so no run's zero is; one that is sought is counted from the first."""
    rig = AXIS.with_effects([TILT(at="base", torque=0.02, angle=0.3)] if stated else [])
    data = dataset(rig, zeroed(*names))
    space = parameters(data, Hypothesis(((ROUND, "encoder"),) if supposed else ()), CENTRES)
    x = space.mean.copy()
    x[space.parts["zeros"]] = 1.0 + np.arange(space.zeros)
    assert [space.zero(x, group) for group in data.zero_groups] == wanted


@pytest.mark.parametrize("stated", [False, True])
def test_in_a_gap_of_the_rig_file_as_in_one_that_is_supposed_the_motors_place_is_unknown(stated) -> None:
    gap = effect_class("backlash")
    flexible = Rig.model_validate(TWO_MASS)
    rig = flexible.with_effects([gap(at="drive", gap=0.02)] if stated else [])
    runs = [run_of(rig, size, "open", f"pulses {size:g}", 1.0) for size in (40.0, 60.0)]
    space = parameters(dataset(rig, runs), Hypothesis(() if stated else ((gap, "drive"),)),
                       {("backlash", "drive"): {"gap": 0.02}})
    x = space.mean.copy()
    x[space.parts["places"]] = 0.5, -0.5
    assert [space.place(x, run) for run in range(2)] == pytest.approx([math.tanh(0.5), -math.tanh(0.5)])


def test_a_run_that_is_left_out_keeps_a_zero_that_no_other_has() -> None:
    data = dataset(AXIS.with_effects([TILT(at="base", torque=0.02, angle=0.3)]), zeroed("bench", "other", "bench"))
    space = parameters(data, Hypothesis(), {})
    x, other = space.mean, space.mean + 1.0
    kept = [space.with_own_of(x, other, run, data.zero_groups) - x for run in range(3)]
    first = space.parts["zeros"].start
    np.testing.assert_array_equal(kept, [np.zeros(space.size), np.arange(space.size) == first + 1,
                                         np.zeros(space.size)])


LOAD = effect_class("load_friction")
LOADED = Hypothesis(((FRICTION, "motor"), (LOAD, "motor")))
SIZES = CENTRES | {("load_friction", "motor"): {"fraction": 0.2}}


def test_what_share_of_the_damping_is_back_emf_is_open_where_it_matters_and_is_not_stated() -> None:
    """Of an axis with friction by load: as likely anywhere from none to all of it."""
    space = parameters(DATA, LOADED, SIZES)
    k = space.parts["back_emf"].start
    assert space.names()[k] == "share of back-EMF" and space.size == len(space.names())
    steps = np.eye(space.size)[k] / math.sqrt(space.precision[k])
    shares = [space.rig_at(space.mean + z * steps).motor.back_emf for z in np.random.default_rng(1).normal(size=2000)]
    np.testing.assert_allclose(np.quantile(shares, [0.1, 0.25, 0.5, 0.75, 0.9]), [0.1, 0.25, 0.5, 0.75, 0.9], atol=0.04)
    assert space.rig_at(space.mean).constants() == pytest.approx(DATA.rig.constants())
    stated = AXIS.with_constants({"motor.back_emf": 0.7})
    for other in (parameters(dataset(stated, runs_of(AXIS)), LOADED, SIZES), parameters(DATA, ONE, CENTRES)):
        assert other.back_emf == 0 and other.rig_at(other.mean).motor.back_emf == other.rig.motor.back_emf
    more = parameters(DATA, LOADED + Hypothesis(((DELAY, "amplifier"),)), SIZES)
    assert more.rig_at(more.carried(space, space.mean + steps)).motor.back_emf == pytest.approx(0.8413, abs=1e-4)
