"""Odds over sets of causes: sums over sets, and what drawing the data again makes of them."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose.estimates import estimates, may_be_none
from station.diagnose.odds import (
    RESAMPLES,
    Draws,
    Odds,
    by_law,
    in_order,
    normalised,
    odds,
    possible,
    resamples,
    with_outside,
)
from station.diagnose.result import Estimate
from station.diagnose.thresholds import BEYOND, OUTSIDE
from station.estimation.dataset import dataset
from station.estimation.identifiability import NORMAL
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.model.effects import catalogue, effect_class
from tests.estimation.made import AXIS, runs_of

FRICTION, DEAD_ZONE = ("coulomb_friction", "motor"), ("dead_zone", "amplifier")
GAIN = ("parameter:motor.gain", "")
Causes = frozenset[tuple[str, str]]


class Searched:
    """A search whose sets score ``scores[set] . drawn``: by stretch, what a set is better by than no cause."""

    def __init__(self, scores: dict[Causes, np.ndarray], owner: np.ndarray) -> None:
        space = SimpleNamespace(rig=AXIS, coordinates=(), parts={"effects": slice(0, 0)})
        self.fits = {keys: SimpleNamespace(key=keys, space=space, by_stretch=row) for keys, row in scores.items()}
        self.predictor = SimpleNamespace(data=SimpleNamespace(
            segment_run=owner, segment_counts=np.ones(len(owner), dtype=bool)))

    def score(self, found: SimpleNamespace) -> float:
        return float(found.by_stretch.sum())

    def scores(self, found: SimpleNamespace, drawn: np.ndarray) -> np.ndarray:
        return drawn @ found.by_stretch


def searched(scores: dict[Causes, np.ndarray], runs: int = 4, each: int = 5) -> Searched:
    return Searched(scores, np.repeat(np.arange(runs), each))


@pytest.mark.parametrize(("share", "sigma", "accused"), [(0.8, 0.1, True), (0.8, 0.2, False), (1.0, 0.01, False),
                                                          (3.0, 0.1, False)])
def test_an_effect_that_may_have_to_be_larger_than_it_can_be_is_not_accused(share: float, sigma: float, accused: bool,
                                                                            ) -> None:
    key, data = ("encoder_eccentricity", "encoder"), dataset(AXIS, runs_of(AXIS))
    largest = effect_class(key[0]).largest(AXIS, key[1])["amplitude"]
    space = parameters(data, Hypothesis(((effect_class(key[0]), key[1]),)), {key: {"amplitude": 2.0, "phase": 0.0}})
    x = space.carried(space, space.mean, {key: {"amplitude": share * largest, "phase": 0.0}})
    found = SimpleNamespace(space=space, x=x, covariance=sigma**2 * np.eye(space.size))
    assert possible(found, key) is accused


def told(effect: tuple[str, str], sizes: dict[str, float], sigma: dict[str, float]) -> bool:
    """Whether an effect may be none that was fitted with these sizes, each so sure in the fit's coordinate."""
    cls, data = effect_class(effect[0]), dataset(AXIS, runs_of(AXIS))
    space = parameters(data, Hypothesis(((cls, effect[1]),)), {effect: cls.guesses(AXIS, effect[1])[0]})
    x = space.carried(space, space.mean, {effect: sizes})
    values = {}
    for k, one in enumerate(space.coordinates, space.parts["effects"].start):
        low, high = (one.to_value(x[k] + way * NORMAL * sigma[one.name]) for way in (-1.0, 1.0))
        values[one.name] = Estimate(value=one.to_value(x[k]), low=low, high=high, unit=one.info.unit)
    return may_be_none(SimpleNamespace(space=space), effect, values)


@pytest.mark.parametrize(("effect", "sizes", "sigma", "none"), [
    (FRICTION, {"torque": 0.03}, {"torque": 0.5}, False), (FRICTION, {"torque": 0.03}, {"torque": 0.52}, True),
    (("actuator_saturation", "amplifier"), {"limit": 90.0}, {"limit": 0.6}, True),
    (("sublinear_drag", "motor"), {"coefficient": 0.02, "speed": 3.0}, {"coefficient": 0.1, "speed": 0.5}, False),
    (("sublinear_drag", "motor"), {"coefficient": 0.02, "speed": 3.0}, {"coefficient": 0.1, "speed": 0.52}, True),
    (("gain_asymmetry", "amplifier"), {"ratio": 0.9}, {"ratio": 0.1}, False),
    (("gain_asymmetry", "amplifier"), {"ratio": 0.9}, {"ratio": 1e3}, True),
    (("gravity_tilt", "base"), {"torque": 0.1, "angle": 1.0}, {"torque": 0.1, "angle": 3.0}, False),
    (("stribeck_friction", "motor"), {"static_torque": 0.04, "coulomb_torque": 0.03, "stribeck_velocity": 1.0},
     {"static_torque": 0.1, "coulomb_torque": 2.0, "stribeck_velocity": 2.0}, False)])
def test_a_size_that_its_interval_does_not_tell_from_none_may_be_none(
        effect: tuple[str, str], sizes: dict[str, float], sigma: dict[str, float], none: bool) -> None:
    """A logarithm's never reaches none, and beyond a factor of e to either side is no knowledge of a size; where and
    how fast a law acts is no size; a law of several sizes is there if one of them is, and levels off if that is."""
    assert told(effect, sizes, sigma) is none


@pytest.mark.parametrize(("low", "none"), [(0.9, True), (1.01, False)])
def test_a_constant_whose_interval_holds_the_rig_files_value_may_be_none(low: float, none: bool) -> None:
    nominal = AXIS.motor.inertia
    value = Estimate(value=1.2 * nominal, low=low * nominal, high=1.4 * nominal, unit="kg m^2")
    found = SimpleNamespace(space=SimpleNamespace(rig=AXIS, coordinates=()))
    assert may_be_none(found, ("parameter:motor.inertia", ""), {"value": value}) is none


def test_a_cause_has_the_probability_of_all_sets_that_hold_it() -> None:
    found = normalised({frozenset(): 0.0, frozenset({FRICTION}): math.log(2.0),
                        frozenset({FRICTION, DEAD_ZONE}): math.log(5.0)}, {FRICTION: 0.9})
    assert found.causes == {FRICTION: pytest.approx(7 / 8), DEAD_ZONE: pytest.approx(5 / 8)}
    assert found.nothing == pytest.approx(1 / 8)
    assert found.sets[0][0] == frozenset({FRICTION, DEAD_ZONE})
    assert found.stability == {FRICTION: 0.9}


def test_what_stands_in_a_causes_place_is_summed_over_the_sets_that_lack_it() -> None:
    found = normalised({frozenset(): 0.0, frozenset({FRICTION}): math.log(2.0), frozenset({DEAD_ZONE}): 0.0}, {})
    assert found.replacements(frozenset({FRICTION}), FRICTION) == {DEAD_ZONE: pytest.approx(0.25)}


def test_what_is_as_likely_comes_in_one_order_whatever_python_hashes() -> None:
    others = [(f"effect_{k}", "motor") for k in range(9)]
    found = normalised({frozenset({FRICTION}): 0.0, frozenset(others): 0.0}, {})
    assert list(found.replacements(frozenset({FRICTION}), FRICTION)) == others


def test_where_more_than_noise_is_left_something_outside_the_catalogue_keeps_what_was_believed_of_it() -> None:
    inside = normalised({frozenset(): 0.0, frozenset({FRICTION}): math.log(2.0), frozenset({DEAD_ZONE}): 0.0},
                        {FRICTION: 0.9})
    found = with_outside(inside)
    assert sum(p for _, p in found.sets) == pytest.approx(1.0 - OUTSIDE)
    assert found.causes == {FRICTION: pytest.approx(0.5 * (1.0 - OUTSIDE)),
                            DEAD_ZONE: pytest.approx(0.25 * (1.0 - OUTSIDE))}
    assert found.nothing == pytest.approx(0.25 * (1.0 - OUTSIDE))
    # Which set is best, and in how many resamples, is no matter of what lies outside.
    assert [keys for keys, _ in found.sets] == [keys for keys, _ in inside.sets]
    assert found.stability == inside.stability


def test_resamples_leave_each_run_out_once_and_then_weigh_every_stretch() -> None:
    owner = np.array([0, 0, 1, 1, 1, 2])
    drawn = resamples(Searched({frozenset(): np.zeros(6)}, owner))
    assert drawn.shape == (3 + RESAMPLES, 6)
    for run in range(3):
        assert np.array_equal(drawn[run], (owner != run).astype(float))
    np.testing.assert_allclose(drawn[3:].sum(axis=1), 6.0)
    assert drawn[3:].min() > 0.0 and drawn[3:].mean(axis=0) == pytest.approx(np.ones(6), abs=0.3)
    assert np.array_equal(drawn, resamples(Searched({frozenset(): np.zeros(6)}, owner)))


def test_with_two_runs_none_is_left_out_whole() -> None:
    assert len(resamples(Searched({}, np.array([0, 0, 1, 1])))) == RESAMPLES


def test_what_no_row_counts_in_is_not_drawn() -> None:
    halves = Searched({}, np.array([0, 0, 1, 1]))
    halves.predictor.data.segment_counts = np.array([True, False, False, True])
    drawn = resamples(halves)
    assert np.all(drawn[:, 1:3] == 0.0) and np.allclose(drawn.sum(axis=1), 2.0)


def test_a_cause_that_every_stretch_asks_for_is_certain_and_stable() -> None:
    found = odds(searched({frozenset(): np.zeros(20), frozenset({FRICTION}): np.full(20, 3.0)}))
    assert found.causes[FRICTION] > 0.999 and found.stability[FRICTION] == pytest.approx(1.0)


def test_a_cause_that_one_stretch_alone_asks_for_is_as_sure_as_that_stretch_is_of_coming_again() -> None:
    """All data together are sure of it by e^12; drawn again they often are not."""
    alone = np.full(20, -1.0)
    alone[3] = 31.0
    found = odds(searched({frozenset(): np.zeros(20), frozenset({FRICTION}): alone}))
    assert alone.sum() == 12.0
    # Weights of the Bayesian bootstrap: 31 w > sum of 19 others of mean 1, so P = E[exp(-sum/31)] = (1 + 1/31)^-19.
    wanted = (1.0 + 1.0 / 31.0) ** -19
    assert found.stability[FRICTION] == pytest.approx(wanted, abs=0.1)
    assert found.causes[FRICTION] == pytest.approx(wanted, abs=0.1)


def test_leaving_out_the_one_run_that_shows_a_cause_counts_against_it() -> None:
    """Of 4 runs one alone speaks for it, in all its stretches: one resample more names nothing."""
    shown = np.where(np.arange(20) < 5, 6.0, -0.1)
    found = odds(searched({frozenset(): np.zeros(20), frozenset({FRICTION}): shown}))
    assert found.stability[FRICTION] == pytest.approx((3 + RESAMPLES) / (4 + RESAMPLES))


def test_stability_is_a_count_over_a_count() -> None:
    """Sums of 1/n are below or above it by rounding, and 0.8 is a threshold."""
    rng = np.random.default_rng(3)
    scores = {frozenset(): np.zeros(20), frozenset({FRICTION}): rng.standard_normal(20)}
    found = odds(searched(scores))
    many, named = len(found.resampled), sum(FRICTION in keys for keys in found.resampled)
    assert 0 < named < many
    assert found.stability[FRICTION] == found.laws[FRICTION[0]] == named / many


def test_rivals_of_which_each_wins_half_of_the_draws_share_the_odds() -> None:
    one = np.tile([8.0, 0.0], 10)
    found = odds(searched({frozenset(): np.full(20, -9.0), frozenset({FRICTION}): one,
                           frozenset({DEAD_ZONE}): one[::-1].copy()}))
    assert found.causes[FRICTION] + found.causes[DEAD_ZONE] == pytest.approx(1.0, abs=1e-6)
    assert 0.3 < found.causes[FRICTION] < 0.7 and found.nothing < 1e-6


@pytest.mark.parametrize(("sigmas", "accused"), [(BEYOND - 0.1, False), (BEYOND + 0.1, True)])
def test_a_constant_is_accused_beyond_three_of_its_own_sigmas_only(sigmas: float, accused: bool) -> None:
    search = searched({frozenset(): np.zeros(20), frozenset({GAIN}): np.ones(20)})
    space = parameters(SimpleNamespace(rig=AXIS, clock=None, zero_groups=[0], runs=[]), Hypothesis(), {})
    for found in search.fits.values():
        logs = 0.1 * sigmas * (np.array(space.paths) == "motor.gain")
        found.space, found.x = space, space.placed(space.mean, logs)
    assert (GAIN in odds(search).causes) is accused


def test_a_common_factor_that_the_others_show_is_no_deviation_of_one() -> None:
    rig = AXIS.model_copy(update={"uncertainty": {"default": 0.01, "motor": 0.1}})
    space = parameters(SimpleNamespace(rig=rig, clock=None, zero_groups=[0], runs=[]), Hypothesis(), {})
    together, apart = (space.deviation(space.placed(space.mean, np.where(there, 0.4, 0.0)), "motor.gain")
                       for there in (np.full(3, True), np.array(space.paths) == "motor.gain"))
    assert together < 1.0 < BEYOND < apart


def torn(motor: float, base: float, nothing: float = 0.0) -> Odds:
    """Friction that resamples put now at the motor, now at the base."""
    at_motor, at_base = frozenset({FRICTION, GAIN}), frozenset({("coulomb_friction", "base"), GAIN})
    found = normalised({keys: math.log(max(p, 1e-9)) for keys, p in
                        ((at_motor, motor), (at_base, base), (frozenset({GAIN}), nothing))},
                       {FRICTION: motor, ("coulomb_friction", "base"): base, GAIN: 1.0})
    return replace(found, laws={"coulomb_friction": motor + base, "parameter:motor.gain": 1.0})


def test_a_law_whose_place_cannot_be_told_is_stated_by_itself_at_the_first_of_its_likely_places() -> None:
    found = by_law(torn(0.4, 0.55, 0.05))
    assert found.causes[FRICTION] == pytest.approx(0.95) and found.stability[FRICTION] == pytest.approx(0.95)
    assert found.sets[0][0] == frozenset({FRICTION, GAIN})
    assert found.replacements(found.sets[0][0], FRICTION) == {("coulomb_friction", "base"): pytest.approx(0.55)}


def test_what_stands_beside_a_law_at_another_place_does_not_stand_in_its_place() -> None:
    at_base = ("coulomb_friction", "base")
    found = normalised({frozenset({FRICTION}): math.log(0.5), frozenset({at_base, DEAD_ZONE}): math.log(0.3),
                        frozenset({DEAD_ZONE}): math.log(0.2)}, {})
    assert found.replacements(frozenset({FRICTION}), FRICTION) == {at_base: pytest.approx(0.3),
                                                                   DEAD_ZONE: pytest.approx(0.2)}


def test_a_place_that_is_told_stands_and_what_has_but_one_place_is_left_alone() -> None:
    found = by_law(torn(0.2, 0.75, 0.05))
    assert found.sets[0][0] == frozenset({("coulomb_friction", "base"), GAIN})
    assert found.causes[GAIN] == pytest.approx(1.0) and found.stability[GAIN] == 1.0
    alone = normalised({frozenset({DEAD_ZONE}): 0.0, frozenset(): -1.0}, {DEAD_ZONE: 0.7})
    assert by_law(alone) == alone


def test_a_level_at_which_readings_stand_still_is_known_no_better_than_their_rounding(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two intervals of one fit the wider one holds the rounding's variance, 1/12 count squared, besides."""
    bias, at = effect_class("command_bias"), "amplifier"

    def width() -> float:
        predictor = Predictor(dataset(AXIS, runs_of(AXIS)), observers(AXIS, 0.0), Pool())
        space = parameters(predictor.data, Hypothesis(((bias, at),)), {("command_bias", at): {"offset": 1.0}})
        found = fit(predictor, space, Weighing(predictor.counts, 1.0), space.mean)
        offset = estimates(found, found, [])[0]["command_bias", at]["offset"]
        return offset.high - offset.low

    plain = width()
    field = bias.model_fields["offset"].json_schema_extra
    monkeypatch.setitem(field, "info", replace(field["info"], rounded=True))
    assert width() == pytest.approx(np.hypot(plain, 2.0 * 1.96 / np.sqrt(12.0)), rel=1e-6)


def test_a_level_of_the_accelerometers_readings_is_rounded_with_them() -> None:
    rounded = {(name, key) for name, cls in catalogue().items() for key, info in cls.parameters().items()
               if info.rounded}
    assert rounded == {("accelerometer_saturation", "limit")}


def ordered(probabilities: dict[tuple[str, str], float], bought: dict[tuple[str, str], float],
            ) -> tuple[list[tuple[str, str]], dict[tuple[str, str], float]]:
    found = Odds([(frozenset(probabilities), 1.0)], probabilities, 0.0, {})
    order, told = in_order(found, frozenset(probabilities), bought.__getitem__, lambda one, other: 0.015)
    return order, told.causes


def test_the_error_of_a_difference_is_that_of_the_data() -> None:
    """A mean of stretches has the standard error of such a mean, and one that no stretch moves that of the draws."""
    rng = np.random.default_rng(7)
    counts = rng.exponential(size=(4000, 25))
    counts *= 25 / counts.sum(axis=1, keepdims=True)
    of_stretch = rng.uniform(0.2, 0.6, 25)
    sets = [frozenset({FRICTION}), frozenset({DEAD_ZONE}), frozenset({FRICTION, DEAD_ZONE})]
    mean, noise = counts @ of_stretch / 25, 0.3 * rng.standard_normal(4000)
    moved = Draws(counts, sets, np.stack([mean, 0.1 * np.ones(4000), 0.2 * np.ones(4000)], axis=1))
    assert moved.error(FRICTION, DEAD_ZONE) == pytest.approx(np.std(of_stretch) / 5.0, rel=0.1)
    assert moved.error(FRICTION, ("coulomb_friction", "base")) == 0.0
    still = Draws(counts, sets, np.stack([0.5 + noise, 0.5 - noise, 0.0 * noise], axis=1))
    assert still.error(FRICTION, DEAD_ZONE) < 5.0 * 0.6 / np.sqrt(4000)


def test_what_the_runs_cannot_tell_apart_stands_by_what_all_data_say_and_has_one_probability() -> None:
    order, told = ordered({FRICTION: 0.96, DEAD_ZONE: 0.98}, {FRICTION: 18.0, DEAD_ZONE: 12.0})
    assert order == [FRICTION, DEAD_ZONE]
    assert told == {FRICTION: pytest.approx(0.97), DEAD_ZONE: pytest.approx(0.97)}


def test_what_is_clearly_more_probable_stands_first_whatever_all_data_say() -> None:
    probabilities = {FRICTION: 0.85, DEAD_ZONE: 1.0, GAIN: 0.84}
    order, told = ordered(probabilities, {FRICTION: 18.0, DEAD_ZONE: 12.0, GAIN: 20.0})
    assert order == [DEAD_ZONE, GAIN, FRICTION]
    assert told == {DEAD_ZONE: pytest.approx(1.0), GAIN: pytest.approx(0.845), FRICTION: pytest.approx(0.845)}


def test_nothing_is_ordered_where_nothing_is_stated() -> None:
    order, told = ordered({}, {})
    assert order == [] and told == {}


def test_fits_without_a_run_widen_an_interval_by_students_t_where_it_is_stated() -> None:
    """Three runs leave it two degrees of freedom, 4.30 standard errors in place of 1.96."""
    predictor = Predictor(dataset(AXIS, runs_of(AXIS)), observers(AXIS, 0.0), Pool())
    key = ("command_bias", "amplifier")
    space = parameters(predictor.data, Hypothesis(((effect_class(key[0]), key[1]),)), {key: {"offset": 1.0}})
    found = fit(predictor, space, Weighing(predictor.counts, 1.0), space.mean)
    k = space.parts["effects"].start
    left_out = [replace(found, x=found.x + away * np.eye(space.size)[k]) for away in (-2.0, 0.5, 1.5)]
    scale = space.coordinates[0].scale
    widths = []
    for student in (True, False):
        offset = estimates(found, found, left_out, student=student)[0][key]["offset"]
        widths.append(0.5 * (offset.high - offset.low) / scale)
    error = np.sqrt(2.0 / 3.0 * (2.0**2 + 0.5**2 + 1.5**2))
    assert widths == pytest.approx([4.3027 * error, 1.96 * error], rel=1e-3)
