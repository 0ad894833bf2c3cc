"""The diagnosis file: its form, and that what stands in it hangs together, on diagnoses of every sort."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from station.diagnose.diagnose import diagnose
from station.diagnose.measures import floor, nrmse
from station.diagnose.result import Cause, Diagnosis, DiagnosisResult, Estimate, Gain, Rival
from station.diagnose.thresholds import EXPLAINABLE
from station.errors import StationError, UsageError, WorkError
from station.estimation.noise import noise_of
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from station.runs.step_response import overshoot
from tests.truth import CONTROLLERS, RIGID_AXIS, SFLR, Conditions, pulse_test, simulate_case, step_test

RATE = 500.0
VERDICTS = {"explained", "partly_explained", "unexplained", "nothing_missing", "ambiguous", "not_enough_data"}
NAMING = {"explained", "partly_explained", "ambiguous"}
TESTS = [step_test(RATE, "p2", 90.0, 1.6), pulse_test(RATE, 120.0, 0.1, duration=1.6),
         step_test(RATE, "lead", -60.0, 1.6)]
AXIS = Rig.model_validate(RIGID_AXIS)
SFLR_RIG = load_rig("sflr")


def made(table: dict, effects: list[dict], tests=TESTS, sigma: float = 0.8) -> list[Run]:
    """Runs of the independent generator on the nominal constants."""
    conditions = [Conditions(accel_sigma=sigma, accel_offset=1.4, seed=i) for i in range(len(tests))]
    runs = []
    for i, (test, out) in enumerate(zip(tests, simulate_case(table, effects, tests, conditions), strict=True)):
        meta = RunMetadata(controller=CONTROLLERS[test.controller], test=test.kind, command_row=-1, zero_id="bench",
                           accel_zero=out.accel_zero)
        runs.append(Run(f"{i + 1}-{test.name}", out.t, out.reference, out.command, out.encoder, out.accel, meta))
    return runs


def effect(name: str, at: str, **parameters: float) -> dict:
    return {"effect": name, "at": at, **parameters}


SECOND_ARM = effect("second_appendage", "", inertia=0.002, stiffness=0.002 * (2.0 * math.pi * 8.0) ** 2,
                    damping=0.002 * 2.0 * 0.01 * 2.0 * math.pi * 8.0)
HEAVY_TIP = SFLR | {"tip": SFLR["tip"] | {"mass": 3.0 * SFLR["tip"]["mass"]}}
STRONG_MOTOR = RIGID_AXIS | {"motor": RIGID_AXIS["motor"] | {"gain": 3.0 * RIGID_AXIS["motor"]["gain"]}}
MADE = {
    "clean": (SFLR_RIG, lambda: made(SFLR, [])),
    "drag": (SFLR_RIG, lambda: made(SFLR, [effect("quadratic_drag", "base", coefficient=0.02)])),
    "constant": (SFLR_RIG, lambda: made(HEAVY_TIP, [])),
    "slip": (SFLR_RIG, lambda: made(SFLR, [effect("encoder_slip", "", counts=9.0, mean_time=0.4)])),
    "second arm": (SFLR_RIG, lambda: made(SFLR, [SECOND_ARM])),
    "nothing moves": (SFLR_RIG, lambda: made(SFLR, [], [step_test(RATE, "p2", 0.0, 0.8) for _ in range(2)])),
    "one rests": (AXIS, lambda: made(RIGID_AXIS, [], [step_test(RATE, "p2", 0.0, 0.8), *TESTS[:2]])),
    "gain": (AXIS, lambda: made(STRONG_MOTOR, [])),
    "repeats": (SFLR_RIG, lambda: made(SFLR, [], [TESTS[0], TESTS[1], TESTS[0], TESTS[0]])),
    "alone": (SFLR_RIG, lambda: made(SFLR, [], TESTS[:1])),
    "either delay": (AXIS, lambda: made(RIGID_AXIS, [effect("input_delay", "amplifier", time=0.007)])),
}
"""The rig that a diagnosis is given, and its runs."""
SECOND = pytest.param("second arm", marks=pytest.mark.long)
NAMES = [SECOND if name == "second arm" else name for name in MADE]


@pytest.fixture(scope="module")
def diagnoses():
    """Each diagnosis once, when first asked for."""
    kept: dict[str, tuple[list[Run], DiagnosisResult]] = {}

    def get(name: str) -> tuple[list[Run], DiagnosisResult]:
        if name not in kept:
            rig, runs = MADE[name][0], MADE[name][1]()
            kept[name] = runs, diagnose(rig, runs, effort="quick")
        return kept[name]

    return get


def strict(text: str) -> dict:
    """JSON as other programs read it: NaN and infinities are none."""
    def refuse(constant: str):
        raise AssertionError(f"{constant} is not JSON")
    return json.loads(text, parse_constant=refuse)


@pytest.mark.parametrize("name", NAMES)
def test_the_file_has_the_contracts_keys(diagnoses, name):
    runs, result = diagnoses(name)
    said = strict(result.diagnosis.to_json())
    assert set(said) == {"schema", "verdict", "wrong", "causes", "gain", "next_experiment", "disturbance",
                         "between_runs", "outside", "ranking", "rig", "runs", "effort", "version"}
    assert said["schema"] == "station-diagnosis/1" and said["verdict"] in VERDICTS
    names = {run.name for run in runs}
    if len(runs) == 1:
        names |= {f"{runs[0].name} ({half} half)" for half in ("first", "second")}
    for row in said["wrong"]:
        assert {"run", "channel", "measure", "simulated", "measured"} <= set(row)
        assert row["run"] in names and row["channel"] in ("encoder", "accel")
    for cause in said["causes"]:
        assert set(cause) == {"effect", "at", "probability", "parameters", "stability", "rivals"}
        assert 0.0 < cause["probability"] <= 1.0 and 0.0 <= cause["stability"] <= 1.0
        assert cause["parameters"]
        for estimate in cause["parameters"].values():
            assert {"value", "low", "high", "unit"} <= set(estimate)
        for rival in cause["rivals"]:
            assert set(rival) == {"effect", "at", "probability"} and 0.0 <= rival["probability"] <= 1.0
    assert {"held_out", "encoder", "accel", "explained_fraction", "runs"} <= set(said["gain"])
    assert set(said["gain"]["held_out"]) <= names
    for channel in ("encoder", "accel"):
        assert said["gain"][channel] is None or set(said["gain"][channel]) == {"nrmse_before", "nrmse_after"}


@pytest.mark.parametrize("name", NAMES)
def test_verdict_causes_and_rivals_agree(diagnoses, name):
    _, result = diagnoses(name)
    said = result.diagnosis
    assert bool(said.causes) == (said.verdict in NAMING)
    probabilities = [cause.probability for cause in said.causes]
    assert probabilities == sorted(probabilities, reverse=True)
    listed = [(cause.effect, cause.at) for cause in said.causes]
    assert len(set(listed)) == len(listed)
    assert {(row.effect, row.at) for row in result.ranking if row.reason.kind == "named"} == set(listed)
    for cause in said.causes:
        rivals = [(rival.effect, rival.at) for rival in cause.rivals]
        assert len(set(rivals)) == len(rivals) and not set(rivals) & set(listed)
    if said.verdict == "ambiguous":
        assert said.next_experiment is not None and said.next_experiment.why


@pytest.mark.parametrize("name", NAMES)
def test_the_extended_rig_holds_the_causes_and_nothing_else(diagnoses, name):
    _, result = diagnoses(name)
    effects = {(e.name, e.at): e.values() for e in result.extended_rig.effects}
    constants = result.extended_rig.constants()
    for cause in result.diagnosis.causes:
        if cause.effect.startswith("parameter:"):
            assert cause.at == "" and set(cause.parameters) == {"value"}
            assert constants[cause.effect.removeprefix("parameter:")] == pytest.approx(cause.parameters["value"].value)
        else:
            values = effects.pop((cause.effect, cause.at))
            assert values == pytest.approx({n: e.value for n, e in cause.parameters.items()})
    assert not effects
    assert Rig.from_toml(result.extended_rig.to_toml(), source="extended") == result.extended_rig


@pytest.mark.parametrize("name", ["clean", "drag", "constant", "slip"])
def test_the_gain_is_that_of_the_simulations_shown(diagnoses, name):
    """nrmse over the held-out runs and the explained share, by the contract's formulas from the comparisons."""
    runs, result = diagnoses(name)
    gain, noise = result.diagnosis.gain, noise_of(runs).sigmas
    assert gain.held_out == [run.name for run in runs]
    shares = []
    for channel, sigma in (("encoder", noise[0]), ("accel", noise[1])):
        before = after = spread = removed = removable = 0.0
        for shown in result.comparisons:
            measured, simulated = getattr(shown.run, channel), getattr(shown.after or shown.refit, channel)
            size = float(np.sum((measured - measured.mean()) ** 2))
            b, a = nrmse(measured, getattr(shown.before, channel)), nrmse(measured, simulated)
            before, after, spread = before + b * b * size, after + a * a * size, spread + size
            if b > EXPLAINABLE * floor(measured, sigma):
                removed, removable = removed + b - a, removable + b - floor(measured, sigma)
        said = getattr(gain, channel)
        assert said.nrmse_before == pytest.approx(math.sqrt(before / spread), rel=1e-6)
        if result.diagnosis.causes or result.diagnosis.verdict == "nothing_missing":
            assert said.nrmse_after == pytest.approx(math.sqrt(after / spread), rel=1e-6)
            if removable:
                shares.append(removed / removable)
    if shares:
        assert gain.explained_fraction == pytest.approx(np.mean(shares), rel=1e-6)
    elif result.diagnosis.causes or result.diagnosis.verdict == "nothing_missing":
        assert gain.explained_fraction is None


def test_a_hidden_drag_is_named_sized_and_worth_it(diagnoses):
    runs, result = diagnoses("drag")
    first = result.diagnosis.causes[0]
    assert (first.effect, first.at) == ("quadratic_drag", "base")
    drag = first.parameters["coefficient"]
    assert drag.unit == "N m s^2/rad^2" and drag.low < 0.02 < drag.high
    assert drag.value == pytest.approx(0.02, rel=0.2)
    for gain in (result.diagnosis.gain.encoder, result.diagnosis.gain.accel):
        assert gain.nrmse_after < 0.7 * gain.nrmse_before
    assert 0.5 < result.diagnosis.gain.explained_fraction < 1.2


def test_what_is_wrong_is_measured_as_the_contract_says(diagnoses):
    runs, result = diagnoses("drag")
    shown = {comparison.run.name: comparison for comparison in result.comparisons}
    checked = set()
    for row in result.diagnosis.wrong:
        run, before = shown[row.run].run, shown[row.run].before
        if row.measure == "overshoot_percent":
            assert row.measured == pytest.approx(overshoot(run.reference, run.encoder))
            assert row.simulated == pytest.approx(overshoot(run.reference, before.encoder))
            assert abs(row.simulated - row.measured) > 100.0 / np.ptp(run.reference)
        elif row.measure == "nrmse":
            assert row.simulated == pytest.approx(nrmse(getattr(run, row.channel), getattr(before, row.channel)))
        checked.add(row.measure)
    assert {"overshoot_percent", "nrmse"} <= checked
    of_runs = [row.measure == "nrmse" for row in result.diagnosis.wrong]
    assert of_runs == sorted(of_runs), "what a step shows stands first, in per cent, errors of runs are shares"
    errors = [row.simulated for row in result.diagnosis.wrong if row.measure == "nrmse"]
    assert errors == sorted(errors, reverse=True)


def test_a_constant_that_is_off_is_no_effect(diagnoses):
    _, result = diagnoses("constant")
    assert [(c.effect, c.at) for c in result.diagnosis.causes] == [("parameter:tip.mass", "")]
    value = result.diagnosis.causes[0].parameters["value"]
    assert value.unit == "kg"
    assert value.low < HEAVY_TIP["tip"]["mass"] < value.high


def test_a_clean_rig_is_not_accused(diagnoses):
    assert diagnoses("clean")[1].diagnosis.verdict == "nothing_missing"


@pytest.mark.parametrize("name", ["slip", SECOND])
def test_what_no_law_describes_is_not_explained(diagnoses, name):
    """Both move the encoder by more than ten counts in every run, and no law of the catalogue does the same."""
    _, result = diagnoses(name)
    assert result.diagnosis.verdict in ("unexplained", "partly_explained")
    assert result.diagnosis.wrong


def test_runs_in_which_nothing_moves_are_not_enough(diagnoses):
    assert diagnoses("nothing moves")[1].diagnosis.verdict == "not_enough_data"


def test_a_right_simulation_errs_by_what_repeats_differ_by(diagnoses):
    _, result = diagnoses("repeats")
    gained = result.diagnosis.gain.runs
    told = {"encoder", "accel", "overshoot_percent", "rise_time"}     # no repeat of this step settles
    assert [set(row.repeats) for row in gained] == [told, set(), told, told]
    for row in gained:
        if row.repeats:
            assert abs(row.after["overshoot_percent"] - row.measured["overshoot_percent"]) < 4.0
            assert row.repeats["overshoot_percent"] < 4.0 and row.repeats["rise_time"] < 0.01
            assert 0.9 < row.accel.nrmse_after / row.repeats["accel"] < 1.1
            assert set(row.measured) == {"overshoot_percent", "rise_time", "settling_time"}


def test_a_run_that_rests_has_no_error_in_units_of_its_motion(diagnoses):
    runs, result = diagnoses("one rests")
    found = result.diagnosis
    assert np.ptp(runs[0].encoder) == 0.0 and [bool(row.ahead) for row in found.gain.runs] == [False, True, True]
    assert all(wrong.run != runs[0].name for wrong in found.wrong if wrong.measure == "nrmse")
    assert Diagnosis.model_validate_json(found.to_json()) == found


def test_two_causes_that_no_test_tells_apart_are_ambiguous(diagnoses):
    """On a rigid axis the loop is the same wherever in it the delay sits."""
    _, result = diagnoses("either delay")
    said = result.diagnosis
    assert said.verdict == "ambiguous"
    first = said.causes[0]
    leading = {(first.effect, first.at), *((rival.effect, rival.at) for rival in first.rivals[:1])}
    assert leading == {("input_delay", "amplifier"), ("encoder_delay", "encoder")}
    assert said.next_experiment.test is None
    assert result.equivalences[0] in said.next_experiment.why


def test_a_wrong_gain_is_ambiguous_whatever_the_odds(diagnoses):
    """Three times the gain is a third of inertia and damping: one cause is likelier than two, but nothing tells."""
    _, result = diagnoses("gain")
    first = result.diagnosis.causes[0]
    assert result.diagnosis.verdict == "ambiguous" and first.effect == "parameter:motor.gain"
    assert first.probability > 0.99
    assert {rival.effect for rival in first.rivals} >= {"parameter:motor.inertia", "parameter:motor.damping"}
    assert all(0.0 < rival.probability < 0.01 for rival in first.rivals)
    assert result.diagnosis.next_experiment.test is None
    assert "motor gain" in result.diagnosis.next_experiment.why


def estimate(value: float = 0.02) -> Estimate:
    return Estimate(value=value, low=0.9 * value, high=1.1 * value, unit="N m")


def test_a_file_reads_back_as_it_was_written():
    whole = Diagnosis(verdict="explained", gain=Gain(held_out=["a", "b"], explained_fraction=None), causes=[
        Cause(effect="coulomb_friction", at="motor", probability=0.98, parameters={"torque": estimate()},
              rivals=[Rival(effect="dead_zone", at="amplifier", probability=0.01)])])
    text = whole.to_json()
    assert Diagnosis.model_validate_json(text) == whole
    assert strict(text)["next_experiment"] is None and strict(text)["gain"]["encoder"] is None


@pytest.mark.parametrize("change", [{"verdict": "solved"}, {"certainty": 1.0}, {"causes": [{"effect": "x"}]},
                                    {"gain": {}}],
                         ids=["verdict", "unknown key", "cause without probability", "gain without runs"])
def test_a_file_of_another_form_is_refused(change):
    good = strict(Diagnosis(verdict="nothing_missing", gain=Gain(held_out=["a"])).to_json())
    with pytest.raises(ValidationError):
        Diagnosis.model_validate(good | change)


def changed(run: Run, **columns) -> Run:
    kept = {"t": run.t, "reference": run.reference, "command": run.command, "encoder": run.encoder, "accel": run.accel}
    return Run(run.name, **(kept | columns), metadata=run.metadata)


def one_line(error: StationError, *words: str) -> None:
    text = str(error)
    assert text and "\n" not in text
    for word in words:
        assert word in text, text


@pytest.fixture(scope="module")
def pair() -> list[Run]:
    return made(SFLR, [], TESTS[:2])


def test_a_run_at_another_rate_is_refused(pair):
    slow = changed(pair[1], t=2.5 * pair[1].t)
    with pytest.raises(WorkError) as refused:
        diagnose(SFLR_RIG, [pair[0], slow], effort="quick")
    one_line(refused.value, slow.name, "200", "500")


def test_a_run_without_the_accelerometer_is_refused(pair):
    deaf = changed(pair[0], accel=None)
    with pytest.raises(WorkError) as refused:
        diagnose(SFLR_RIG, [deaf, pair[1]], effort="quick")
    one_line(refused.value, deaf.name, "accelerometer")


@pytest.mark.parametrize("column", ["t", "reference", "command", "encoder", "accel"])
def test_a_run_that_is_not_a_number_cannot_be_made(pair, column):
    values = getattr(pair[0], column).copy()
    values[17] = math.nan
    with pytest.raises(WorkError) as refused:
        changed(pair[0], **{column: values})
    one_line(refused.value, pair[0].name, column, "17")


def test_a_run_of_irregular_time_cannot_be_made(pair):
    jumpy = pair[0].t.copy()
    jumpy[40:] += 0.004
    with pytest.raises(WorkError) as refused:
        changed(pair[0], t=jumpy)
    one_line(refused.value, pair[0].name, "40")


def test_wrong_use_is_told_from_failed_work(pair):
    with pytest.raises(UsageError) as refused:
        diagnose(SFLR_RIG, pair, effort="heroic")
    one_line(refused.value, "heroic", "quick", "full")
    with pytest.raises(UsageError) as refused:
        diagnose(SFLR_RIG, [], effort="quick")
    one_line(refused.value, "run")


def test_a_run_that_is_alone_is_judged_half_by_half_and_is_no_repeat_of_itself(diagnoses):
    (run,), result = diagnoses("alone")
    first, second = result.comparisons
    assert (first.rows ^ second.rows).all() and first.rows[: len(run) // 2].all()
    for row, comparison in zip(result.diagnosis.gain.runs, result.comparisons, strict=True):
        assert row.repeats == {}
        error = nrmse(run.accel[comparison.rows], comparison.before.accel[comparison.rows])
        assert comparison.errors("accel")[0] == pytest.approx(error) == row.accel.nrmse_before
    assert [bool(row.measured) for row in result.diagnosis.gain.runs] == [True, False], "the step is in the first half"


def test_the_file_is_the_same_whatever_the_order_of_runs_which_stand_in_that_of_their_names():
    names = "step", "step (2)"
    runs = [replace(run, name=name) for run, name in zip(made(RIGID_AXIS, [], TESTS[:2]), names, strict=True)]
    found = [diagnose(AXIS, given, effort="quick") for given in (runs, runs[::-1])]
    assert found[0].diagnosis.to_json() == found[1].diagnosis.to_json()
    for result in found:
        assert [row.run.name for row in result.comparisons] == result.diagnosis.gain.held_out == list(names)
