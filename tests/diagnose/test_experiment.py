"""The next experiment: what separates rivals, what a refit absorbs, what shows, and what the station can run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.control.named import NAMED
from station.control.references import reference_from_test
from station.diagnose import diagnose as module
from station.diagnose.experiment import _telling, choose, first_test
from station.diagnose.forecasts import Belief, absorbed
from station.diagnose.planner import SPEED_OVER, Planner, Worth
from station.diagnose.result import Prediction
from station.diagnose.separating import between
from station.diagnose.showing import showing, told, visible
from station.diagnose.thresholds import VISIBLE
from station.diagnose.trials import LEAD, OPEN, P, Trial, trials
from station.estimation.pool import Pool
from station.model.effects import effect_class
from station.model.simulate import build, simulate_model
from station.rig import Limits, Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.estimation.made import AXIS as RIGID
from tests.estimation.made import runs_of

SFLR = load_rig("sflr")
AXIS = Rig.from_toml("""
name = "axis"
sample_rate = 1000.0
[amplifier]
limit = 100.0
[motor]
inertia = 0.001
damping = 0.02
gain = 0.01
[encoder]
counts_per_revolution = 4096
""", source="axis")
SIGMA = np.array([0.3, 1.0])
PATHS = ["motor.damping", "drive.stiffness"]
STEPS = [Trial({"kind": "step", "amplitude": 20.0}, P), Trial({"kind": "step", "amplitude": 160.0}, P)]


@pytest.fixture(scope="module")
def planner():
    return Planner(SFLR, SIGMA, Pool())


def gone(trial: Trial) -> Run:
    """A test that took the arm a quarter of a turn."""
    run = trial.as_run(SFLR)
    return replace(run, encoder=np.linspace(0.0, SFLR.encoder.counts_per_revolution / 4.0, len(run)))


def hypothesis(words: str, *effects, sigma: float = 0.01, shift: float = 0.0, paths=PATHS) -> Belief:
    """sflr with effects, some constants known to ``sigma`` (of their logarithm) and off by ``shift``."""
    nominal = np.array([SFLR.constants()[path] for path in paths])

    def model(x):
        rig = SFLR.with_constants(dict(zip(paths, nominal * np.exp(x), strict=True)))
        return build(rig.with_effects(effects), 0.1, 1e-3)
    return Belief(words, np.full(len(paths), shift), sigma * np.eye(len(paths)), model)


def effect(name: str, at: str, **values: float):
    return effect_class(name)(at=at, **values)


def test_what_a_refit_may_do_is_taken_out_by_its_own_covariance():
    rng = np.random.default_rng(1)
    spread, change = rng.normal(size=(4, 30)), rng.normal(size=(3, 30))
    full = np.linalg.inv(np.eye(30) + spread.T @ spread)
    assert np.allclose(absorbed(change, spread), change @ full)
    assert np.allclose(absorbed(change[0], spread), change[0] @ full)
    wide = 1e4 * spread[:1]
    assert spread[0] @ absorbed(spread[0], wide) < 1e-6 < 1.0 < change[0] @ absorbed(change[0], spread[:0])


def test_a_difference_that_refitted_constants_absorb_separates_nothing(planner):
    """Two rigs whose constants are 1 % apart: told apart where they are known to 0.01 %, not where known to 10 %."""
    sharp, wide = (between(planner, [hypothesis("one", sigma=s), hypothesis("other", sigma=s, shift=0.01)],
                           [0.5, 0.5])(STEPS) for s in (1e-4, 0.1))
    assert sharp[1].decides and sharp[1].value > 0.99
    assert not any(worth.decides for worth in wide) and all(worth.value < 0.3 for worth in wide)


def test_structure_is_told_apart_where_constants_are_not(planner):
    friction = hypothesis("friction", effect("coulomb_friction", "motor", torque=0.03), sigma=0.1)
    dead = hypothesis("dead zone", effect("dead_zone", "amplifier", width=3.0), sigma=0.1)
    assert all(worth.decides for worth in between(planner, [friction, dead], [0.5, 0.5])(STEPS))


def test_the_test_is_chosen_for_the_rivals_that_are_likely(planner):
    """A saturation shows in the large step alone, a small dead zone better in the small one's slow end."""
    plain = hypothesis("plain", sigma=0.03)
    clipped = hypothesis("clipped", effect("actuator_saturation", "amplifier", limit=120.0), sigma=0.03)
    small, large = between(planner, [plain, clipped], [0.5, 0.5])(STEPS)
    assert small.value < 0.01 < 0.9 < large.value
    dead = hypothesis("dead", effect("dead_zone", "amplifier", width=2.0), sigma=0.03)
    likely = between(planner, [plain, dead, clipped], [0.6, 0.4, 1e-6])(STEPS)
    pair = between(planner, [plain, dead], [0.6, 0.4])(STEPS)
    assert [worth.value for worth in likely] == pytest.approx([worth.value for worth in pair], rel=1e-3)


def test_what_is_predicted_of_a_choice_is_what_the_two_rivals_do(planner):
    plain = hypothesis("plain")
    clipped = hypothesis("clipped", effect("actuator_saturation", "amplifier", limit=120.0))
    judged = between(planner, [plain, clipped], [0.5, 0.5])(STEPS)[1]
    test, found = judged.trial.complete(), judged.prediction
    assert found.names == ("plain", "clipped") and len(found.t) == len(found.encoder[0]) == len(found.accel[1])
    assert test["controller"] == P and test["duration"] == 2.0
    assert np.max(np.abs(found.encoder[0] - found.encoder[1])) > 5.0


def test_effects_that_look_alike_count_but_once(planner):
    base = hypothesis("plain", sigma=0.03)
    delay = ("delay", effect("input_delay", "amplifier", time=0.003))
    dead = ("dead zone", effect("dead_zone", "amplifier", width=6.0))
    once, twice, both = (showing(planner, base, some)(STEPS[1:])[0].value
                         for some in ([delay], [delay, delay], [delay, dead]))
    assert once < twice < once + np.log(2.0) + 1e-6 < both


def test_what_the_runs_so_far_have_shown_is_worth_less(planner):
    """A dead zone that a small step has shown is no reason for another test; a saturation, which it hides, is."""
    base = hypothesis("plain", sigma=0.03)
    dead = ("dead zone", effect("dead_zone", "amplifier", width=6.0))
    clipped = ("clipping", effect("actuator_saturation", "amplifier", limit=120.0))
    after = Planner(SFLR, SIGMA, planner.pool, [gone(STEPS[0])])
    other = Trial({"kind": "triangle", "amplitude": 40.0}, P)
    fresh, seen = (showing(p, base, [dead])([other])[0].value for p in (planner, after))
    assert seen < 0.5 * fresh
    small, large = showing(after, base, [dead, clipped])([other, STEPS[1]])
    assert small.value < large.value and "1 of 2 effects of a usual size would show that the runs" in large.why
    assert large.prediction.names == ("plain", "with clipping")


def test_what_the_runs_have_shown_does_not_hang_on_the_count_at_which_they_began(planner):
    base, dead = hypothesis("plain", sigma=0.03), ("dead zone", effect("dead_zone", "amplifier", width=6.0))
    run = gone(STEPS[0])
    elsewhere = replace(run, encoder=run.encoder + 300.0, reference=run.reference + 300.0)
    one, other = (showing(Planner(SFLR, SIGMA, planner.pool, [past]), base, [dead])(STEPS[1:])[0].value
                  for past in (run, elsewhere))
    assert other == pytest.approx(one, rel=1e-3)


def test_runs_add_up_to_what_all_of_them_say_together():
    rng = np.random.default_rng(2)
    spread, change, nuisance = rng.normal(size=(3, 40)), rng.normal(size=(2, 40)), rng.normal(size=(2, 20))
    parts = [told(spread[:, half], change[:, half], nuisance) for half in (slice(20), slice(20, None))]
    apart = np.zeros((4, 40))
    apart[:2, :20] = apart[2:, 20:] = nuisance
    whole = absorbed(change, np.concatenate([spread, apart])) @ change.T / VISIBLE
    assert np.allclose(visible(parts[0] + parts[1], 3), whole)


def worth(trial: Trial, value: float, cost: float) -> Worth:
    return Worth(trial, value, cost, "", Prediction(np.zeros(1), ("", ""), (np.zeros(1),) * 2, None), 0.0)


def test_of_tests_that_are_worth_the_same_the_gentler_is_taken(planner):
    gentle, hard = STEPS
    table = {str(gentle.test): (0.95, 0.5), str(hard.test): (1.0, 2.0)}

    def judge(tried):
        return [worth(trial, *table.get(str(trial.test), (0.1, 9.0))) for trial in tried]
    assert planner.best(judge, [gentle, hard]).trial == gentle
    table[str(gentle.test)] = (0.8, 0.5)
    assert planner.best(judge, [gentle, hard]).trial == hard
    assert planner.best(lambda tried: [], [gentle]) is None
    assert planner.best(lambda tried: [worth(trial, -1e-12, 1.0) for trial in tried], [gentle]) is not None


def made(test: dict, controller: dict) -> Run:
    zeros = np.zeros(10)
    return Run("run", np.arange(10) / 500.0, zeros, zeros, zeros, zeros,
               RunMetadata(test=test, controller=controller))


def test_a_test_that_was_run_is_not_run_again_unless_by_a_margin(planner):
    trial = Trial({"kind": "step", "amplitude": 100.0}, LEAD)
    again = made({"kind": "step", "amplitude": -110, "both": True}, {**LEAD, "zero": 31.4159, "accel_zero": 3.0})
    assert trial.repeats([again])
    for other in (made({"kind": "step", "amplitude": 40}, LEAD), made({"kind": "step", "amplitude": 100}, P),
                  made({"kind": "pulse", "amplitude": 100}, OPEN), made({}, {})):
        assert not trial.repeats([other])
    done = Planner(SFLR, SIGMA, planner.pool, [again])
    assert done.worth(trial, 1.0) < done.worth(STEPS[0], 0.6) < done.worth(trial, 1.3)


@pytest.mark.parametrize("rig", [SFLR, AXIS], ids=lambda rig: rig.name)
def test_every_test_is_one_that_the_station_can_run(rig):
    every = trials(rig, [("gravity_tilt", "base"), ("input_delay", "amplifier"), ("parameter:motor.gain", "")])
    assert len(every) > 10
    for trial in every:
        asked = trial.complete()
        controller = asked.pop("controller")
        reference = reference_from_test(asked, rig.sample_rate)
        Compensator.from_spec(controller, rig.sample_rate, rig.amplifier.limit)
        assert trial.closed or np.max(np.abs(reference)) <= rig.amplifier.limit
        assert asked["amplitude"] == round(asked["amplitude"]) and {"duration", "rest"} <= asked.keys()
        assert controller["kind"] != "lead_accel" or rig.accelerometer is not None


def test_no_test_asks_for_more_command_than_the_rig_file_allows():
    gentle = SFLR.model_copy(update={"limits": Limits(command=60.0)})
    assert gentle.amplifier.limit > 60.0
    largest = []
    for trial in trials(gentle, [("torque_ripple", "motor")]):
        assert np.max(np.abs(trial.as_run(gentle).command)) <= 60.0
        if not trial.closed:
            largest.append(np.max(np.abs(reference_from_test(trial.test, gentle.sample_rate))))
    assert max(largest) == 60.0


def test_a_finer_encoder_is_asked_for_the_same_angles_at_the_same_effort():
    for trial in (t for t in trials(AXIS) if t.closed and t.controller["kind"] == "p"):
        counterparts = [t for t in trials(SFLR) if t.test["kind"] == trial.test["kind"]
                        and t.amplitude == trial.amplitude / 4.0 and t.controller["kind"] == "p"]
        efforts = {t.amplitude * t.controller["gain"] / SFLR.amplifier.limit for t in counterparts}
        assert trial.amplitude * trial.controller["gain"] / AXIS.amplifier.limit in efforts


def test_a_test_that_would_throw_the_rig_about_is_not_chosen(planner):
    calm, wild = (Trial({"kind": "step", "amplitude": 60.0}, {**P, "gain": gain}) for gain in (2.0, 400.0))
    belief = hypothesis("plain")
    assert [planner.behaves(trial, planner.forecasts(belief, [trial.as_run(SFLR)])[0]) for trial in (calm, wild)] == \
        [True, False]
    far = Trial({"kind": "pulse", "amplitude": 200.0, "width": 1.0}, OPEN)
    assert not planner.behaves(far, planner.forecasts(belief, [far.as_run(SFLR)])[0])


def test_no_test_goes_faster_than_the_rig_file_lets_it(planner):
    """The device stops a test at ``limits.speed``."""
    stated, rows = SFLR.model_copy(update={"limits": Limits(speed=2.0)}), round(SPEED_OVER * SFLR.sample_rate)
    pace = Planner(stated, planner.sigma, planner.pool).pace
    assert planner.pace == np.inf and pace == pytest.approx(2.0 * SPEED_OVER / SFLR.angle_per_count)
    fastest = []
    for rig in (stated, SFLR):
        test = first_test(rig).next.test
        trial = Trial({k: v for k, v in test.items() if k != "controller"}, test["controller"])
        made = simulate_model(build(rig.meshed()), trial.as_run(rig)).encoder
        fastest.append(np.max(np.abs(made[rows:] - made[:-rows])))
    assert 0.0 < fastest[0] <= pace + 1.0 < fastest[1]


def test_no_test_goes_beyond_what_the_rig_file_or_the_runs_say_a_rig_can_go(planner):
    """Nobody knows how far a rig can go whose file does not say: an axis has ends."""
    short = Trial({"kind": "step", "amplitude": 20.0}, P).as_run(SFLR)
    far = replace(short, encoder=np.linspace(100.0, 160.0, len(short)))
    turn = SFLR.encoder.counts_per_revolution
    stated = SFLR.model_copy(update={"limits": Limits(travel=80.0 * SFLR.angle_per_count)})

    def reach(rig, *runs):
        return Planner(rig, planner.sigma, planner.pool, runs).reach

    assert (reach(SFLR), reach(SFLR, short), reach(SFLR, short, far)) == (turn / 2.0, turn / 20.0, 120.0)
    beyond = replace(short, encoder=np.linspace(0.0, turn, len(short)))
    assert reach(SFLR, beyond) == turn, "where it went before"
    assert reach(stated) == reach(stated, far) == pytest.approx(80.0)
    choice = first_test(stated)
    model = build(stated.meshed())
    trial = Trial({k: v for k, v in choice.next.test.items() if k != "controller"}, choice.next.test["controller"])
    assert np.max(np.abs(simulate_model(model, trial.as_run(stated)).encoder)) <= 80.0


@pytest.mark.parametrize("rig", [SFLR, AXIS], ids=lambda rig: rig.name)
def test_the_first_test_shows_most_of_the_catalogue_and_is_complete(rig):
    choice = first_test(rig)
    test = dict(choice.next.test)
    assert test.pop("controller")["kind"] in {spec["kind"] for spec in NAMED.values()}
    reference_from_test(test, rig.sample_rate)
    shown, all_ = (int(word) for word in choice.next.why.split() if word.isdigit())
    assert "effects of a usual size would show, " in choice.next.why
    assert shown >= 0.75 * all_
    assert (choice.prediction.accel is None) == (rig.accelerometer is None)
    assert choice.plan == choice.next


def test_a_rig_without_any_bearable_test_is_told_so():
    wild = replace_gain(AXIS, 1e5)
    assert first_test(wild).next.test is None


def replace_gain(rig: Rig, factor: float) -> Rig:
    return rig.model_copy(update={"motor": rig.motor.model_copy(update={"gain": factor * rig.motor.gain})})


def test_planned_runs_carry_the_loop_as_the_station_runs_it():
    run = STEPS[0].as_run(SFLR)
    assert run.metadata.command_row == -1 and run.metadata.controller == P
    hard = replace(STEPS[0], test={"kind": "pulse", "amplitude": 900.0}, controller=OPEN).as_run(SFLR)
    assert np.max(np.abs(hard.command)) == SFLR.amplifier.limit


def test_the_words_of_the_effects_say_what_to_look_for():
    """Those of every effect that is named; a constant, or nothing, has none."""
    said = _telling(frozenset([("dead_zone", "amplifier"), ("parameter:tip.mass", "")]))
    assert said == f" (dead zone: {effect_class('dead_zone').telling})" and "Coulomb friction" in said
    assert _telling(frozenset()) == _telling(frozenset([("parameter:tip.mass", "")])) == ""


def test_a_rig_of_which_constants_are_exact_has_a_first_test() -> None:
    """Two of one table, with a factor that they share: their covariance by itself is singular."""
    exact = AXIS.model_copy(update={"uncertainty": {**AXIS.uncertainty, "motor": 0.5, "motor.inertia": 0.0,
                                                    "motor.damping": 0.0}})
    assert first_test(exact).next.test is not None


def test_where_a_verdict_asks_for_no_test_none_is_worked_out_until_somebody_asks(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "choose", lambda *what: asked.append(what[-1]) or choose(*what))
    dry = effect("coulomb_friction", "motor", torque=0.02 * RIGID.motor.gain * RIGID.amplifier.limit)
    found = module.diagnose(RIGID, runs_of(RIGID.with_effects([dry])), effort="quick")
    assert (found.diagnosis.verdict, found.diagnosis.next_experiment, asked) == ("explained", None, [])
    assert found.choice.plan.test is not None and found.choice is found.choice and asked == ["explained"]
