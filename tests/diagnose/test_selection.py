"""The score by which sets of causes are judged, on evidences made up."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from station.diagnose import refits, selection
from station.diagnose import search as searches
from station.diagnose.candidates import candidates
from station.diagnose.effort import EFFORTS
from station.diagnose.refits import finish, look_back
from station.diagnose.remainder import remainder
from station.diagnose.rung import taking_in
from station.diagnose.screening import Screened
from station.diagnose.search import leading
from station.diagnose.selection import Selection
from station.diagnose.thresholds import LOG_PRIOR, LOG_PRIOR_PARAMETER
from station.estimation.cause import constant
from station.estimation.constants import base_fit, unknown
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.parameters import CLOCK_SIGMA, Hypothesis, Parameters, parameters
from station.estimation.prediction import COARSE, FINE, Predictor
from station.model.effects import effect_class
from station.rig import Rig, load_rig
from station.runs.ticks import CLOCKS
from tests.estimation.made import AXIS, predictions, run_of, runs_of
from tests.truth import RIGID_AXIS, TWO_MASS

FRICTION, STRIBECK, CLOCK = ((effect_class(name), at) for name, at in (
    ("coulomb_friction", "motor"), ("stribeck_friction", "motor"), ("clock_scale", "")))


class Found(SimpleNamespace):
    """A fit made up: one of its kind, as fits are, whatever it holds."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__


def found(evidence: float, *effects: tuple, constants: tuple[str, ...] = (), narrowed: float = 0.0,
          lost: tuple[float, float] = (0.0, 0.0)) -> Found:
    """``lost``: what the evidence loses where runs are held alike in their share of the command, and in a constant."""
    hypothesis = Hypothesis(effects, constants)
    space = SimpleNamespace(hypothesis=hypothesis, rig=None, coordinates=(), parts={"effects": slice(0, 0)})
    made = Found(space=space, key=hypothesis.key,
                 log_evidence=lambda weighing, found_by: evidence - np.dot(lost, np.equal(weighing.differ, 0.0)),
                 log_evidences=lambda weighing, sizes, drawn, found_by: (
                     evidence - np.dot(lost, np.equal(sizes, 0.0)) - drawn),
                 most_likely_differ=lambda weighing: tuple(map(float, weighing.may)),
                 log_narrowing=lambda weighing: np.array([narrowed, 0.0]))
    made.light = made
    return made


def searching(clock: tuple[float, float] | None = None) -> Selection:
    return Selection(SimpleNamespace(data=SimpleNamespace(clock=clock, rig=None)), EFFORTS["quick"],
                     Weighing(np.ones((1, 1)), 1.0))


def complete(predictor: Predictor) -> Selection:
    """A search in which nothing but noise is left."""
    return Selection(predictor, EFFORTS["quick"], Weighing(predictor.at_longest.counts, 1.0), complete=True)


def test_each_cause_and_each_further_parameter_costs_its_prior() -> None:
    search = searching()
    assert search.score(found(10.0)) == 10.0
    assert search.score(found(10.0, FRICTION)) == pytest.approx(10.0 + LOG_PRIOR)
    further = len(STRIBECK[0].parameters()) - 1
    assert further > 0
    both = search.score(found(10.0, FRICTION, STRIBECK, constants=("motor.gain",)))
    assert both == pytest.approx(10.0 + 3.0 * LOG_PRIOR + further * LOG_PRIOR_PARAMETER)


def test_sizes_of_differences_that_runs_single_out_cost_what_singling_out_costs() -> None:
    search = searching()
    one, drawn = found(10.0, narrowed=-3.0), np.array([0.0, 2.0, np.inf])
    assert search.score(one) == 7.0 and search.scores(one, drawn).tolist() == [7.0, 5.0, -np.inf]


def test_where_only_noise_is_left_that_runs_differ_costs_what_a_cause_does_and_a_set_may_do_without() -> None:
    """Where more is left, that runs differ is a part of it, and costs no more than to say by how much."""
    needy, easy = found(20.0, narrowed=-3.0, lost=(12.0, 1.0)), found(20.0, FRICTION, narrowed=-3.0, lost=(1.0, 1.0))
    search = searching()
    assert search.score(needy) == 17.0 and search.score(easy) == 17.0 + LOG_PRIOR
    search = searching()
    search.complete = True
    assert search.score(needy) == pytest.approx(20.0 - 1.0 - 3.0 + LOG_PRIOR)
    assert search.own_weighing(needy).differ == (1.0, 0.0)
    assert search.score(easy) == pytest.approx(20.0 - 2.0 + LOG_PRIOR)
    assert search.own_weighing(easy).differ == (0.0, 0.0)


def test_a_size_is_known_by_what_compares_sets() -> None:
    """Where whole runs compare none a fit knows its sizes by the short horizon, as well as that tells them."""
    predictor = predictions(AXIS, runs_of(AXIS))
    search = Selection(predictor, EFFORTS["quick"], Weighing(0.02 * predictor.counts, 1.0))
    space = parameters(predictor.data, Hypothesis((FRICTION,)), {("coulomb_friction", "motor"): {"torque": 0.02}})
    fitted = fit(predictor, space, search.weighing, space.mean, predictor.data.own, iterations=2)
    assert search.known(fitted) is fitted
    search.judging = Weighing(0.02 * predictor.counts * predictor.ahead, 1.0)
    known, [place] = search.known(fitted), range(space.size)[space.parts["effects"]]
    assert np.all(known.x == fitted.x) and known.covariance[place, place] > 1.01 * fitted.covariance[place, place]
    quick = replace(fitted.weighing, independent=fitted.weighing.independent * ~predictor.longest)
    np.testing.assert_allclose(known.covariance, replace(fitted, weighing=quick).covariance, rtol=1e-9)
    search.found_by = search.weighing
    assert search.known(fitted) is fitted, "whole runs alone compare, and all say where parameters are"


def test_clocks_that_disagree_speak_against_every_set_that_leaves_the_boards_clock_right() -> None:
    """One that is off may be so by any ratio of its prior: what was read is one of many."""
    search, ratio = searching((1.004, 0.001)), math.log(1.004)
    assert search.score(found(0.0)) == pytest.approx(-0.5 * (ratio / 0.001) ** 2)
    right, off = (norm.logpdf(ratio, scale=width) for width in (0.001, math.hypot(0.001, CLOCK_SIGMA)))
    assert search.score(found(0.0, CLOCK)) - search.score(found(0.0)) == pytest.approx(LOG_PRIOR + off - right)


def test_where_no_second_clock_watched_it_a_clock_is_off_by_what_oscillators_are() -> None:
    """By an eighth none is: a wrong inertia is likelier then, of which a file may be wrong by anything."""
    predictor = predictions(AXIS, runs_of(AXIS))
    clock = effect_class("clock_scale")
    for guess in (0.97, 1.03):
        centres = {("clock_scale", "clock"): {"ratio": guess}}
        space = parameters(predictor.data, Hypothesis(((clock, "clock"),)), centres)
        [place] = range(space.size)[space.parts["effects"]]
        [coordinate] = space.coordinates
        assert coordinate.to_value(space.mean[place]) == 1.0
        assert coordinate.scale / math.sqrt(space.precision[place]) == pytest.approx(CLOCK_SIGMA)


@pytest.mark.parametrize(("ratio", "is_off"), [(1.0, False), (1.00008, False), (0.9997, False), (1.0007, True),
                                               (0.999, True), (1.02, True)])
def test_two_clocks_that_tick_apart_as_quartz_clocks_do_are_both_right(ratio: float, is_off: bool) -> None:
    search = searching((ratio, CLOCKS))
    assert (search.score(found(0.0, CLOCK)) > search.score(found(0.0))) == is_off


def test_of_two_fits_of_the_same_causes_the_better_one_is_kept_and_the_best_set_is_found() -> None:
    search = searching()
    for evidence in (20.0, 30.0, 25.0):
        search.keep(found(evidence, FRICTION))
    search.keep(found(22.0))
    assert search.score(search.best()) == pytest.approx(30.0 + LOG_PRIOR) and len(search.fits) == 2
    search.keep(found(30.0 + LOG_PRIOR + 1.0))
    assert search.best().key == frozenset()


def test_a_fit_that_went_on_from_another_stands_in_its_place_whatever_that_promised() -> None:
    search = searching()
    search.keep(promising := found(30.0, FRICTION))
    search.keep(gone_on := found(25.0, FRICTION), promising)
    assert search.fits[gone_on.key] is gone_on
    search.keep(found(20.0, FRICTION), promising)
    assert search.fits[gone_on.key] is gone_on


def test_the_likeliest_sets_are_close_down_to_a_limit_and_a_number() -> None:
    search = searching()
    for evidence, effects in ((30.0, (FRICTION,)), (20.0, ()), (40.0, (FRICTION, CLOCK)), (3.0, (CLOCK,))):
        search.keep(found(evidence, *effects))
    assert [f.key for f in search.close(9)] == [{("coulomb_friction", "motor"), ("clock_scale", "")},
                                                {("coulomb_friction", "motor")}, frozenset()]
    assert len(search.close(2)) == 2


def test_an_evidence_that_is_no_number_never_wins() -> None:
    assert searching().score(found(float("nan"))) == -np.inf


def test_a_fit_that_stopped_above_what_was_promised_of_its_causes_is_taken_further_before_one_that_arrived() -> None:
    search, ripple = searching(), (effect_class("torque_ripple"), "motor")
    best, arrived, short = found(60.0, FRICTION), found(40.0, STRIBECK), found(30.0, ripple)
    best.objective, arrived.objective, short.objective = 880.0, 920.0, 940.0
    fits = {one.key: one for one in (best, arrived, short)}
    assert leading(search, fits, {}) == [best, arrived, short]
    # Promised is an objective 100 lower, 50 in log likelihood: more than the best one has.
    assert leading(search, fits, {short.key: 840.0}) == [best, short, arrived]
    # A fit that came lower than was promised has nothing left to reach.
    assert leading(search, fits, {short.key: 941.0, arrived.key: 900.0}) == [best, arrived, short]


def test_nothing_that_simulates_leaves_nothing_to_take_further() -> None:
    assert leading(searching(), {}, {}) == []


def test_a_law_must_hold_against_one_that_it_holds_fitted_from_where_it_ended() -> None:
    """Friction of two levels explains friction of one: begun from the rig alone the one may have ended anywhere."""
    torque = 0.03 * AXIS.motor.gain * AXIS.amplifier.limit
    predictor = predictions(AXIS, runs_of(AXIS.with_effects([FRICTION[0](at="motor", torque=torque)])))
    search = complete(predictor)

    def ended(*effects: tuple, sizes: dict, **how: int) -> None:
        space = parameters(predictor.data, Hypothesis(effects), sizes)
        search.keep(fit(search.predictor, space, search.weighing, space.mean.copy(), **how))

    coulomb, stribeck = ("coulomb_friction", "motor"), ("stribeck_friction", "motor")
    ended(sizes={})
    ended(FRICTION, sizes={coulomb: {"torque": 0.1 * torque}}, iterations=1)
    levels = {"static_torque": 1.5 * torque, "coulomb_torque": torque, "stribeck_velocity": 0.2}
    ended(STRIBECK, sizes={stribeck: levels})
    assert search.best().key == {stribeck}
    look_back(search, search.best())
    assert search.best().key == {coulomb}
    assert search.best().space.values(search.best().x)[coulomb]["torque"] == pytest.approx(torque, rel=0.02)


@pytest.mark.parametrize(("law", "sizes", "truth", "sized"), [
    (("torque_ripple", "motor"), {"amplitude": 0.3, "cycles": 1.02, "phase": 3.0}, ("gravity_tilt", "base"),
     {"torque": 0.3, "angle": 0.0}),
    (("sublinear_drag", "motor"), {"coefficient": 3.0, "speed": 0.02}, ("coulomb_friction", "motor"),
     {"torque": 0.06})])
def test_a_law_must_hold_against_what_it_nearly_is_where_it_ended(
        law: tuple[str, str], sizes: dict[str, float], truth: tuple[str, str], sized: dict[str, float]) -> None:
    """A ripple of one cycle against a pendulum's weight, drag that levels off at once against Coulomb friction."""
    cls, at = effect_class(truth[0]), truth[1]
    predictor = predictions(AXIS, runs_of(AXIS.with_effects([cls(at=at, **sized)])))
    search, ended = complete(predictor), (effect_class(law[0]), law[1])
    for effects, begun in (((), {}), ((ended,), {law: sizes})):
        space = parameters(predictor.data, Hypothesis(effects), begun)
        search.keep(fit(search.predictor, space, search.weighing, space.mean.copy()))
    assert search.best().key == {law}
    look_back(search, search.best())
    assert search.best().key == {truth}
    found = search.best().space.values(search.best().x)[truth]
    assert found == pytest.approx(sized, rel=0.02, abs=0.002)


@pytest.mark.parametrize(("counts", "noise"), [(0.8, True), (3.0, False)])
def test_a_run_whose_start_was_read_wrong_and_that_is_hardly_believed_leaves_noise_all_the_same(
        counts: float, noise: bool) -> None:
    """By how little it counted its start stayed wrong, and for its wrong start it counted little."""
    fine = Rig.model_validate({**RIGID_AXIS, "encoder": {"counts_per_revolution": 50_000.0}})
    runs = [run_of(fine, amplitude, "open", f"{amplitude:g}", 2.0) for amplitude in (60.0, 40.0)]
    predictor = predictions(fine, runs)
    first, second = predictor.data.records
    wrong = replace(second, start=second.start + counts * fine.angle_per_count)
    predictor = predictor.on(replace(predictor.data, records=(first, wrong)))
    space = parameters(predictor.data, Hypothesis(), {})
    independent = predictor.counts * [[1.0], [1e-3]]
    found = fit(predictor, space, replace(unknown(predictor), independent=independent, differ=(0.0, 0.0)), space.mean)
    assert not remainder(predictor, found).is_noise
    search = Selection(predictor, EFFORTS["quick"], found.weighing)
    search.fits = {found.key: found}
    begun = search.weigh(found)
    assert search.complete is noise
    moved = begun.own[1, 0] - second.start
    assert (abs(moved) < 0.3 * fine.angle_per_count) == noise


@pytest.mark.parametrize(("true", "place"), [("motor", "base"), ("base", "motor")])
def test_a_law_must_hold_against_itself_at_its_other_places(true: str, place: str) -> None:
    """What rubs at one end of a shaft was told as what rubs at the other, where nothing else came to be tried."""
    rig, coulomb = Rig.model_validate(TWO_MASS), FRICTION[0]
    torque = 0.08 * rig.motor.gain * rig.amplifier.limit
    predictor = predictions(rig, runs_of(rig.with_effects([coulomb(at=true, torque=torque)])))
    search = complete(predictor)
    for effects in ((), ((coulomb, place),)):
        space = parameters(predictor.data, Hypothesis(effects), {("coulomb_friction", place): {"torque": torque}})
        search.keep(fit(search.predictor, space, search.weighing, space.mean.copy()))
    assert search.best().key == {("coulomb_friction", place)}
    look_back(search, search.best())
    best = search.best()
    assert best.key == {("coulomb_friction", true)}
    assert best.space.values(best.x)["coulomb_friction", true]["torque"] == pytest.approx(torque, rel=0.05)


@pytest.mark.parametrize("looked", [True, False])
def test_delays_must_hold_against_those_of_the_same_sums(monkeypatch: pytest.MonkeyPatch, looked: bool) -> None:
    """A command that is late, told as two sensors that are, with nothing that would lead from there to it."""
    rig = load_rig("sflr")
    command, encoder, accel = ((effect_class(name), at) for name, at in (
        ("input_delay", "amplifier"), ("encoder_delay", "encoder"), ("accelerometer_delay", "accelerometer")))
    predictor = predictions(rig, runs_of(rig.with_effects([command[0](at="amplifier", time=0.0123)])))
    search = complete(predictor)
    sizes = {("encoder_delay", "encoder"): {"time": 0.0123}, ("accelerometer_delay", "accelerometer"): {"time": 0.0123}}
    for effects, begun in (((), {}), ((encoder, accel), sizes)):
        space = parameters(predictor.data, Hypothesis(effects), begun)
        search.keep(fit(search.predictor, space, search.weighing, space.mean.copy()))
    assert search.best().key == set(sizes)
    if not looked:
        monkeypatch.setattr(refits, "delays_traded", lambda causes, rig, allowed: [])
    look_back(search, search.best())
    best = search.best()
    assert (best.key == {("input_delay", "amplifier")}) is looked
    if looked:
        time = best.space.values(best.x)["input_delay", "amplifier"]["time"]
        assert time == pytest.approx(0.0123, abs=0.15 * rig.period)


def test_a_ripple_is_nearly_a_tilt_only_of_one_cycle_and_without_a_drive() -> None:
    ripple, sizes = effect_class("torque_ripple"), {"amplitude": 0.3, "cycles": 1.3, "phase": 1.0}
    x = np.linspace(-4.0, 4.0, 9)
    [(key, tilt)] = ripple.cases(AXIS, "motor", sizes).items()
    theirs = [effect_class(key[0]).law(one, 0.0, 0.0, list(tilt.values()), [], 1e-3) for one in x]
    np.testing.assert_allclose(theirs, 0.3 * np.sin(x + 1.0), atol=1e-12)
    assert not ripple.cases(AXIS, "motor", {**sizes, "cycles": 1.6})
    assert not ripple.cases(load_rig("sflr"), "motor", sizes)


def test_a_best_set_that_ended_elsewhere_is_looked_back_upon_before_it_is_told() -> None:
    """A cause alone that was never begun where the whole set ended; and one that was, is not begun again."""
    torque = 0.03 * AXIS.motor.gain * AXIS.amplifier.limit
    predictor = predictions(AXIS, runs_of(AXIS.with_effects([FRICTION[0](at="motor", torque=torque)])))
    coulomb, delay = ("coulomb_friction", "motor"), ("input_delay", "amplifier")

    def ended(*effects: tuple, sizes: dict) -> None:
        space = parameters(predictor.data, Hypothesis(effects), sizes)
        search.keep(fit(search.predictor, space, search.weighing, space.mean.copy()))

    for seen in (False, True):
        search = complete(predictor)
        ended(sizes={})
        ended(FRICTION, (effect_class("input_delay"), "amplifier"),
              sizes={coulomb: {"torque": torque}, delay: {"time": 0.1 * AXIS.period}})
        search.weigh(search.best())
        assert search.best().key == {coulomb, delay}
        if seen:
            look_back(search, search.best())
            del search.fits[frozenset({coulomb})]
        finish(search)
        assert (frozenset({coulomb}) in search.fits) != seen
        if not seen:
            assert search.best().key == {coulomb}


def test_where_nothing_but_noise_is_left_whole_runs_alone_are_predicted_and_where_more_is_all_horizons_again() -> None:
    """And what is kept of the sets that were fitted before can be compared with those that are fitted after."""
    torque = 0.03 * AXIS.motor.gain * AXIS.amplifier.limit
    predictor = predictions(AXIS, runs_of(AXIS.with_effects([FRICTION[0](at="motor", torque=torque)])))
    search = Selection(predictor, EFFORTS["quick"], Weighing(predictor.counts, 1.0))
    for effects, sizes in (((), {}), ((FRICTION,), {("coulomb_friction", "motor"): {"torque": torque}})):
        space = parameters(predictor.data, Hypothesis(effects), sizes)
        search.keep(fit(predictor, space, search.weighing, space.mean.copy(), to_the_end=True).light)
    alone, friction = search.fits.values()
    search.looked_back = alone

    quiet = search.weigh(friction)
    assert search.complete and search.predictor.observers == predictor.observers[-1:]
    assert quiet.squares.shape == (len(predictor.data.runs), 1) == search.weighing.independent.shape
    np.testing.assert_array_equal(quiet.squares, friction.squares[:, predictor.longest])
    assert search.score(search.fits[friction.key]) > search.score(search.fits[alone.key])
    assert search.is_news(search.best(), search.looked_back)

    loud = search.weigh(search.fits[alone.key])
    assert not search.complete and search.predictor is predictor
    for before, after in ((alone, loud), (alone, search.fits[alone.key]), (friction, search.fits[friction.key])):
        np.testing.assert_allclose(after.squares, before.squares, rtol=1e-6)  # observers start elsewhere
        assert after.log_evidence(search.weighing) == pytest.approx(before.log_evidence(search.weighing), abs=0.5)
    assert search.score(search.fits[friction.key]) > search.score(search.fits[alone.key])
    assert search.is_news(search.best(), search.looked_back)


@pytest.mark.parametrize(("turns", "rounds"), [(0, 2), (1, 3), (3, 5), (1000, 5)])
def test_what_errors_count_for_is_read_off_the_best_set_however_often_that_changes(
        monkeypatch: pytest.MonkeyPatch, turns: int, rounds: int) -> None:
    """One of four sets after another is the best by what the one before says; where that never ends, the search does.
    """
    class Turning(Selection):
        read = 0

        @property
        def wanted(self) -> tuple:
            return self.best().key, False

        def best(self):
            return list(self.fits.values())[min(self.read, turns) % 4]

        def weigh(self, found):
            self.read, self.weighed_by = self.read + 1, found.key
            return found

    refitted = []
    monkeypatch.setattr(refits, "refit", lambda search, fits, to_the_end: refitted.append(search.weighed_by))
    monkeypatch.setattr(refits, "look_back", lambda search, one: None)
    search = Turning(**vars(searching()))
    for effects in ((), (FRICTION,), (STRIBECK,), (CLOCK,)):
        search.keep(found(10.0, *effects))
    search.weighed_by = frozenset({("another", "")})
    finish(search)
    assert len(refitted) == rounds and (search.wanted == search.reading) == (turns < 1000)


def test_beside_a_law_its_special_case_is_no_cause_and_the_law_takes_it_in() -> None:
    """Stribeck friction where Coulomb friction is holds it: begun in its place, with its torque on top."""
    stribeck, coulomb, at_base = Hypothesis((STRIBECK,)), Hypothesis((FRICTION,)), Hypothesis(((STRIBECK[0], "base"),))
    less = coulomb.causes[0]
    assert stribeck.holds(less) and not coulomb.holds(stribeck.causes[0])
    assert not at_base.holds(less) and not stribeck.holds(stribeck.causes[0])
    cause = next(c for c in candidates(AXIS) if c.key == stribeck.causes[0])
    guess = {"static_torque": 0.03, "coulomb_torque": 0.01, "stribeck_velocity": 1.0}
    begin = taking_in(Screened(cause, guess, 10.0, 1.0, 10.0), less, {"torque": 0.02})
    assert begin == {cause.key: guess | {"coulomb_torque": pytest.approx(0.03)}}
    drag = next(c for c in candidates(AXIS) if c.key[0] == "quadratic_drag")
    other = Screened(drag, drag.guesses[0], 10.0, 1.0, 10.0)
    assert taking_in(other, less, {"torque": 0.02}) == other.start


@pytest.mark.parametrize("noise", [True, False])
def test_where_more_than_noise_is_left_the_horizon_that_shows_it_compares(monkeypatch: pytest.MonkeyPatch, noise: bool,
                                                                          ) -> None:
    """The quick one, by what was read just before; where it is left with the sensors' noise alone, whole runs."""
    predictor = predictions(AXIS, runs_of(AXIS))
    space = parameters(predictor.data, Hypothesis(), {})
    search = Selection(predictor, EFFORTS["quick"], Weighing(predictor.counts, 1.0))
    search.keep(one := fit(predictor, space, search.weighing, space.mean.copy(), iterations=1))
    search.weighed_by = one.key
    monkeypatch.setattr(selection, "ahead_is_noise", lambda predictor, found, alone: noise)
    search.judge()
    counted = search.compared.independent.sum(axis=0) > 0.0
    assert len(counted) == 2 and counted.tolist() == (predictor.longest if noise else predictor.ahead).tolist()
    assert search.found_by is (search.weighing if noise else None)
    search = complete(predictor)
    search.judge()
    assert search.compared is search.weighing


def test_what_misses_more_just_ahead_does_not_win_by_whole_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the quick horizon is left with noise by the rig alone, a set that leaves more there has it against it:
    whole runs hold few independent errors, and a fit that stopped far away is credited with what one more step might
    do."""
    search = searching()
    search.all_horizons.longest = search.all_horizons.ahead = None
    for effects in ((), (FRICTION,), (STRIBECK,)):
        search.keep(found(10.0, *effects))
    astray = Hypothesis((STRIBECK,)).causes[0]
    monkeypatch.setattr(selection, "ahead_is_noise", lambda predictor, best, alone: noise)
    monkeypatch.setattr(selection, "misses_more_ahead", lambda predictor, one, best: astray in one.key)
    monkeypatch.setattr(selection, "weighing_of", lambda *given: search.weighing)
    for noise, kept in ((False, 3), (True, 2)):
        search.judge()
        assert len(search.fits) == kept and (frozenset({astray}) in search.fits) is not noise


def test_a_horizon_that_compares_nothing_still_says_where_the_constants_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """A load of 1.9 times the inertia in the file, and a slow swing that no model knows: whole runs hold so few
    independent errors that by them alone the rig's constants go home, and what they were strained by is forgotten."""
    rig, path = Rig.model_validate(TWO_MASS), "base.inertia"
    heavy = rig.with_constants({path: 1.9 * rig.base.inertia})
    runs = [run_of(heavy, size, loop, f"{size}", 2.0) for size, loop in ((90.0, "p2"), (-60.0, "p1"), (60.0, "open"),
                                                                       (150.0, "p2"))]
    swings = (np.round(6.0 * np.sin(2.0 * np.pi * 0.7 * run.t + k)) for k, run in enumerate(runs))
    predictor = predictions(rig, [replace(run, encoder=run.encoder + swing)
                                  for run, swing in zip(runs, swings, strict=True)])
    alone = base_fit(predictor)
    search = Selection(predictor, EFFORTS["quick"], alone.weighing)
    search.keep(search.weigh(alone))
    for hypothesis in (Hypothesis(), Hypothesis((), (path,))):
        space = parameters(predictor.data, hypothesis, {})
        search.keep(fit(predictor, space, search.weighing, space.carried(alone.space, alone.x), alone.own))
    monkeypatch.setattr(selection, "ahead_is_noise", lambda predictor, found, alone: True)
    search.judge()
    gained = []
    for weighing in (search.weighing, None):
        search.found_by = weighing
        search._weighed.clear()
        nothing, heavier = (search.score(search.fits[frozenset(keys)]) for keys in ((), [constant(path)]))
        gained.append(heavier - nothing)
    assert gained[0] > 3.0 and gained[1] < 1.0


@pytest.mark.parametrize(("moved", "again"), [((3.0, 3.5), False), ((3.0, -40.0), True), ((np.nan, 0.0), True)])
def test_what_a_searchs_simulations_err_by_decides_between_no_sets(
        monkeypatch: pytest.MonkeyPatch, moved: tuple[float, float], again: bool) -> None:
    """Of a shaft that hardens by a fine encoder a load friction of a ten-thousandth was named by 0.84; by finer
    simulations it takes nothing away."""
    predictor = predictions(AXIS, runs_of(AXIS))
    one = complete(replace(predictor, accuracy=COARSE))
    for k, effects in enumerate(((), (FRICTION,))):
        space = parameters(predictor.data, Hypothesis(effects), {("coulomb_friction", "motor"): {"torque": 0.01}})
        one.keep(fit(one.predictor, space, one.weighing, space.mean.copy(), iterations=12 * k))
    more, finished = dict(enumerate(moved)), []

    def finer(given: Predictor, space: Parameters, *where: object) -> SimpleNamespace:
        assert given.accuracy == FINE
        key = space.hypothesis.key
        return SimpleNamespace(objective=one.fits[key].objective + more[len(key)])

    monkeypatch.setattr(searches, "point", finer)
    monkeypatch.setattr(searches, "finish", lambda given: finished.append(given.predictor.accuracy))
    searches._compare_exactly(one)
    assert finished == [FINE] * again and one.all_horizons.accuracy == COARSE
    one.complete = False
    searches._compare_exactly(one)
    assert finished == [FINE] * again
