"""Numbers and sentences that people read."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from station.diagnose.equivalences import TABLE
from station.diagnose.result import (
    NOT_NAMED,
    BetweenRuns,
    Cause,
    ChannelGain,
    Diagnosis,
    DiagnosisResult,
    Disturbance,
    Estimate,
    Gain,
    Ranked,
    RankedCause,
    Reason,
    Rival,
    Wrong,
)
from station.view import wording
from station.view.report import report_html
from station.view.terminal import print_diagnosis
from tests.view import made


@pytest.mark.parametrize(("value", "text"), [
    (0.0, "0"), (0.0305, "0.0305"), (-0.0107, "−0.0107"), (8123.0, "8123"), (1.0e-5, "1.00 × 10⁻⁵"),
    (1234567.0, "1.23 × 10⁶"), (None, "–"), (float("inf"), "infinite"), (float("nan"), "undefined")])
def test_numbers_keep_three_digits(value: float | None, text: str) -> None:
    assert wording.number(value) == text


def test_an_interval_decides_how_many_digits_a_value_shows() -> None:
    assert wording.interval(Estimate(value=0.12345, low=0.1234, high=0.1235, unit="kg")) == \
        "0.12345 kg (0.12340 to 0.12350)"
    assert wording.interval(Estimate(value=0.12345, low=0.05, high=0.5, unit="")) == "0.12 (0.050 to 0.50)"


@pytest.mark.parametrize(("verdict", "fraction", "words"), [
    ("explained", 1.02, "all of the error above the noise is gone"),
    ("partly_explained", 1.02, "nearly all of the error above the noise is gone"),
    ("explained", 0.93, "93 % of the error above the noise is gone, the rest within the uncertainty of the fits"),
    ("partly_explained", 0.93, "93 % of the error above the noise is gone"),
    ("explained", -0.1, "the error of whole runs is not smaller, within the uncertainty of the fits"),
    ("partly_explained", -0.1, "the error of whole runs is not smaller"), ("explained", None, "")])
def test_the_share_that_is_gone_and_the_verdict_say_the_same(verdict: str, fraction: float | None, words: str) -> None:
    causes = made.result(verdict).diagnosis.causes
    gain = Gain(held_out=["one"], explained_fraction=fraction)
    outside = 0.09 if verdict == "partly_explained" else 0.0
    assert wording.gone(Diagnosis(verdict=verdict, causes=causes, gain=gain, outside=outside)) == words
    assert wording.gone(Diagnosis(verdict=verdict, gain=gain)) == ""


def test_notes_of_the_diagnosis_name_causes_by_their_titles() -> None:
    assert wording.plain("as part of sublinear_drag@motor + dead_zone@amplifier") == \
        "as part of sublinear drag at the motor + dead zone in the amplifier"
    assert wording.plain("parameter:drive.damping + coulomb_friction at base differ by chi^2 = 15") == \
        "wrong drive damping + Coulomb friction at the base differ by χ² = 15"
    assert wording.plain("parameter:tip.mass@ + made_up@motor") == "wrong tip mass + made_up@motor"


def test_what_is_tried_beside_others_says_what_it_adds() -> None:
    title = "as part of backlash in the drive + dead zone in the amplifier"

    def said(kind: str = "open", value: float = 0.0, adds: float | None = None) -> str:
        return wording.why(Reason(kind, value, tried="as part of backlash@drive + dead_zone@amplifier", adds=adds))
    assert said() == title, "nothing is known of what it adds"
    assert said("too_little", 8.8, 0.3) == f"{title}: adds nothing to 2 Δln L"
    assert said("too_little", 8.8, 6.0) == f"{title}: adds 6.00 to 2 Δln L, too little (it must add 8.8)"
    assert said(adds=52.8) == f"{title}: adds 52.8 to 2 Δln L"
    assert said("within", adds=52.8) == \
        f"{title}: adds 52.8 to 2 Δln L; a value within the rig's stated uncertainty does as well"
    assert said("too_large") == f"{title}; it may have to be larger than such a thing can be"
    assert said("resamples") == f"{title}; no resample names it"


def test_a_test_is_told_with_six_digits() -> None:
    assert wording.test_words({"kind": "lead", "zero": 31.41592653589793, "numerator": [1.0, 0.00045097]}) == \
        "lead, zero 31.4159, numerator [1, 0.00045097]"


def test_odds_never_claim_certainty() -> None:
    assert wording.probability(0.99999) == "> 99.9 %"
    assert wording.probability(1e-9) == "< 0.1 %"
    assert wording.probability(0.983) == "98 %"
    assert wording.probability(0.9985) == "99.9 %" and wording.probability(0.9962) == "99.6 %"


@pytest.mark.parametrize(("effect", "at", "title"), [
    ("coulomb_friction", "motor", "Coulomb friction at the motor"),
    ("dead_zone", "amplifier", "dead zone in the amplifier"), ("encoder_delay", "encoder", "encoder delay"),
    ("parameter:beam.mass_per_length", "", "wrong beam mass per length"),
    ("made_up_effect", "motor", "made up effect at the motor"), ("none", "", "none of these")])
def test_causes_have_titles(effect: str, at: str, title: str) -> None:
    assert wording.cause_title(effect, at) == title


@pytest.mark.parametrize(("verdict", "words"), [
    ("explained", "leaves out Coulomb friction at the motor; with that put right, only noise"),
    ("partly_explained", "has a wrong tip mass (0.00613 kg where these runs say 0.00920); with that put right"),
    ("ambiguous", "cannot tell whether it is Coulomb friction at the motor or Stribeck friction at the motor."),
    ("unexplained", "re-fitted a torque of 22 % of the command's is still missing, and no cause known here is named"),
    ("nothing_missing", "Nothing is missing"), ("not_enough_data", "not enough")])
def test_each_verdict_is_one_plain_sentence(verdict: str, words: str) -> None:
    result = made.result(verdict)
    sentence = wording.verdict_sentence(result.diagnosis, result.rig)
    assert words in sentence
    assert sentence.endswith(".") and sentence.count(". ") == 0


def test_a_settling_that_never_comes_says_so() -> None:
    item = Wrong(run="a", channel="encoder", measure="settling_time", simulated=None, measured=1.25)
    assert wording.measure(item) == ("angle settling time", "never", "1.25 s")


def test_what_stands_in_a_candidates_place_is_named() -> None:
    one, two, three = ("backlash", "drive"), ("encoder_delay", "encoder"), ("parameter:tip.mass", "")
    assert wording.why(Reason("beaten", instead=(one,))) == "backlash in the drive in its place does better"
    assert wording.why(Reason("matched", instead=(one, two))) == \
        "backlash in the drive and encoder delay in its place do as well"
    assert wording.why(Reason("matched", instead=(one, two, three))) == \
        "backlash in the drive, encoder delay and wrong tip mass in its place do as well"


def test_the_terminal_shows_hostile_names_as_text() -> None:
    out = io.StringIO()
    result = made.hostile()
    result.notes.append("\x1b[2J")
    object.__setattr__(result.comparisons[0].run, "name", "[red]\x1b]0;title\x07")
    print_diagnosis(result, Console(file=out, width=200, force_terminal=True))
    assert "\x1b]0" not in out.getvalue() and "[red]\\x1b]0;title\\x07" in out.getvalue()


def test_the_terminal_shows_causes_candidates_and_gain() -> None:
    out = io.StringIO()
    print_diagnosis(made.result(), Console(file=out, width=140))
    for words in ("Coulomb friction at the motor", "93 %", "0.1 s ahead", "4.0 % → 1.1 %", "not settled",
                  "0.0305 N m (0.0291 to 0.0319)", "does not help on unseen runs",
                  "no fit has seen",
                  "Next: station run pulse --port PORT --rig RIG --amplitude 25 --duration 2 --out pulse-25.mcap"):
        assert words in out.getvalue(), words


LATE = Cause(effect="encoder_delay", at="encoder", probability=0.34, stability=0.53,
             parameters={"time": Estimate(value=0.00032, low=0.00024, high=0.00041, unit="s")},
             rivals=[Rival(effect="input_delay", at="amplifier", probability=0.36),
                     Rival(effect="actuator_lag", at="amplifier", probability=0.2),
                     Rival(effect="cable_spring", at="base", probability=0.013)])
SAME = next(row.sentence for row in TABLE if row.name == "delays")


def late(verdict: str = "ambiguous", accelerometer: bool = False, equivalences: tuple[str, ...] = (SAME,),
         cause: Cause = LATE, named: int = 1) -> DiagnosisResult:
    """A diagnosis that names friction for certain, and a delay."""
    found = made.result(verdict)
    sure = found.diagnosis.causes[0].model_copy(update={"rivals": []})
    rig = found.rig if accelerometer else found.rig.model_copy(update={"accelerometer": None})
    rows = [RankedCause(LATE.effect, LATE.at, 0.34, 597.0, None, stability=0.53),
            RankedCause("input_delay", "amplifier", 0.36, 600.0, None, stability=0.3)]
    diagnosis = found.diagnosis.model_copy(update={"causes": [sure, cause][:named + 1]})
    return replace(found, diagnosis=diagnosis, rig=rig, equivalences=list(equivalences), ranking=rows)


def headline(result: DiagnosisResult) -> str:
    return wording.verdict_sentence(wording.as_told(result), result.rig)


def test_what_is_certain_stands_apart_from_what_is_undecided() -> None:
    assert headline(late(equivalences=())) == (
        "The simulation leaves out Coulomb friction at the motor. Something more is wrong, but these runs cannot tell "
        "whether it is encoder delay, input delay in the amplifier or actuator lag in the amplifier.")
    likely = LATE.model_copy(update={"probability": 0.5, "rivals": LATE.rivals[2:]})
    assert headline(late(equivalences=(), cause=likely)).endswith("is encoder delay or cable spring at the base.")
    alone = LATE.model_copy(update={"rivals": []})
    assert headline(late(cause=alone)).endswith(
        "Something more is wrong; encoder delay would explain it, but these runs cannot settle it.")


def test_a_cause_that_is_sure_is_never_called_undecided() -> None:
    unsure = [Rival(effect="cable_spring", at="base", probability=0.013)]
    result = late(equivalences=())
    sure = result.diagnosis.causes[0].model_copy(update={"probability": 0.9, "stability": 0.98, "rivals": unsure})
    found = result.diagnosis.model_copy(update={"causes": [sure, LATE], "outside": 0.09})
    said = wording.verdict_sentence(found, result.rig)
    assert said.startswith("The simulation leaves out Coulomb friction at the motor. ") and "cable spring" not in said


def test_a_delay_that_no_test_places_is_told_as_one_latency() -> None:
    told = wording.as_told(late())
    assert [(wording.cause_title(c.effect, c.at), round(c.probability, 2), round(c.stability, 2))
            for c in told.causes[1:]] == [("latency in the loop (encoder or input)", 0.7, 0.83)]
    assert headline(late()).endswith("cannot tell whether it is a latency of 0.32 ms in the loop (encoder or input) or "
                                     "actuator lag in the amplifier.")
    settled = LATE.model_copy(update={"probability": 0.5, "stability": 0.6, "rivals": LATE.rivals[:1]})
    assert headline(late(cause=settled)) == (
        "The simulation leaves out Coulomb friction at the motor and a latency of 0.32 ms in the loop (encoder or "
        "input). These runs cannot tell whether that latency stands at the encoder or at the input.")
    assert "and probably leaves out a latency of 0.32 ms in the loop" in headline(late("partly_explained"))
    result, out = late(), io.StringIO()
    print_diagnosis(result, Console(file=out, width=200))
    for text in (out.getvalue(), report_html(result)):
        assert "one latency with the encoder delay, which no test tells from it" in text


@pytest.mark.parametrize("facts", [{"accelerometer": True}, {"equivalences": ()}, {"named": 0}])
def test_delays_that_something_tells_apart_stay_two(facts: dict[str, Any]) -> None:
    result = late(**facts)
    assert wording.as_told(result) is result.diagnosis


@pytest.mark.parametrize(("share", "words"), [
    (0.004, "but little: with its constants re-fitted no torque is missing a few hundredths of a second ahead (less "
            "than 0.5 % of the command's); what is left shows in whole runs alone."),
    (0.012, "but little: with its constants re-fitted all that is left is a torque of 1.2 % of the command's, which no "
            "law of the catalogue describes."),
    (0.1, "with its constants re-fitted a torque of 10 % of the command's is still missing")])
def test_what_is_unexplained_says_how_much(share: float, words: str) -> None:
    found = made.result("unexplained")
    missing = Disturbance(nominal=0.2, refitted=share, extended=share)
    said = wording.verdict_sentence(found.diagnosis.model_copy(update={"disturbance": missing}), found.rig)
    assert words in said
    runs = BetweenRuns(constant=2.5, probability={"constant": 0.91}, stability={"constant": 1.0})
    differ = found.diagnosis.model_copy(update={"disturbance": missing, "between_runs": runs})
    assert ("wrong: from run to run the motor does more or less by itself. With that and its constants re-fitted" in
            wording.verdict_sentence(differ, found.rig))
    none = wording.verdict_sentence(found.diagnosis.model_copy(update={"disturbance": None}), found.rig)
    assert none.startswith("The simulation gets something wrong, and no cause known here")


@pytest.mark.parametrize(("probable", "words"), [
    (0.42, "wrong: with its constants re-fitted"), (0.6, "from run to run the motor probably does more or less"),
    (0.91, "from run to run the motor does more or less")])
def test_runs_that_likely_do_not_differ_are_not_said_to_in_the_headline(probable: float, words: str) -> None:
    found = made.result("unexplained")
    runs = BetweenRuns(share=0.05, probability={"share": probable}, stability={"share": 0.9})
    told = found.diagnosis.model_copy(update={"between_runs": runs, "outside": 0.09,
                                              "disturbance": Disturbance(nominal=0.2, refitted=0.1, extended=0.1)})
    assert words in wording.verdict_sentence(told, found.rig)


@pytest.mark.parametrize(("probable", "words"), [
    ((0.9, 0.75), "The simulation leaves out Coulomb friction at the motor and Stribeck friction at the motor; with"),
    ((0.9, 0.65), "leaves out Coulomb friction at the motor, and probably leaves out Stribeck friction at the motor;"),
    ((0.9, 0.41), "leaves out Coulomb friction at the motor, and perhaps leaves out Stribeck friction at the motor;"),
    ((0.6, 0.41), "The simulation probably leaves out Coulomb friction at the motor, and perhaps leaves out Stribeck")])
def test_a_headline_is_no_surer_than_the_odds(probable: tuple[float, float], words: str) -> None:
    found = made.result("partly_explained")
    first = made.result("explained").diagnosis.causes[0]
    causes = [first.model_copy(update={"effect": effect, "at": "motor", "probability": p}) for effect, p in
              zip(("coulomb_friction", "stribeck_friction"), probable, strict=True)]
    told = found.diagnosis.model_copy(update={"causes": causes, "outside": 0.09})
    assert words in wording.verdict_sentence(told, found.rig)


@pytest.mark.parametrize(("share", "outside", "words"), [
    (0.175, 0.09, "but a torque of 18 % of the command's is still missing."), (0.004, 0.09, "more than noise remains."),
    (0.175, 0.0, "more than noise remains.")])
def test_a_headline_says_how_much_torque_the_causes_leave(share: float, outside: float, words: str) -> None:
    left = Disturbance(nominal=0.4, refitted=0.3, extended=share)
    found = made.result("partly_explained")
    told = found.diagnosis.model_copy(update={"disturbance": left, "outside": outside})
    assert wording.verdict_sentence(told, found.rig).endswith(words)
    found = made.result("ambiguous")
    told = found.diagnosis.model_copy(update={"disturbance": left, "outside": outside})
    said = wording.verdict_sentence(told, found.rig)
    assert said.endswith("Whichever it is, a torque of 18 % of the command's is still missing.") is ("18" in words)


@pytest.mark.parametrize("disturbance", [None, Disturbance(nominal=0.6, refitted=0.5, extended=0.5)])
def test_what_runs_left_out_speak_against_is_told_as_that(disturbance: Disturbance | None) -> None:
    found, note = made.result("unexplained"), NOT_NAMED["left_out"]
    rows = [Ranked(effect="backlash", at="drive", probability=0.91, note=note),
            Ranked(effect="hardening_spring", at="drive", probability=0.91, note=note),
            Ranked(effect="dead_zone", at="amplifier", probability=0.3)]
    for count, words in ((1, "backlash in the drive, which most resamples name, does not help on runs that no fit has "
                             "seen."), (2, "hardening spring in the drive, which most resamples name, do not help")):
        told = found.diagnosis.model_copy(update={"disturbance": disturbance, "ranking": rows[:count] + rows[2:]})
        said = wording.verdict_sentence(told, found.rig)
        assert words in said and "no cause known here is named: backlash" in said and "dead zone" not in said


@pytest.mark.parametrize(("before", "after", "words"), [
    (2.0, 0.8, "Re-fitting alone does 83 % of that, the causes the rest."), (20.0, 0.9, "does nearly all of that."),
    (2.0, 1.0, "does all of that. But 5 of 5 runs are met better with the causes."), (0.9, 0.5, "does none of that."),
    (0.5, 0.9, "with the causes.")])
def test_re_fittings_share_of_the_gain_is_told(before: float, after: float, words: str) -> None:
    result = made.result()
    refit = result.refitted("encoder")
    gain = Gain(held_out=["a"], encoder=ChannelGain(nrmse_before=before * refit, nrmse_after=after * refit))
    told = wording.beyond(replace(result, diagnosis=result.diagnosis.model_copy(update={"gain": gain})))
    assert len(told) == 1 and told[0].endswith(words)
    worse = [replace(row, after=row.before) for row in result.comparisons]
    told = wording.beyond(replace(result, comparisons=worse, diagnosis=result.diagnosis.model_copy(
        update={"gain": gain})))
    assert told[0].endswith(words.removesuffix(" But 5 of 5 runs are met better with the causes."))


def test_what_a_refit_strains_is_told_by_name() -> None:
    result = made.result("unexplained")
    stated, named = result.rig.constants(), {c.effect for c in result.diagnosis.causes}
    assert not named
    moved = {"motor.inertia": 1.32, "motor.gain": 0.8, "drive.stiffness": 1.01}
    rig = result.rig.model_copy(update={"uncertainty": {"default": 0.1}})
    constants = {path: Estimate(value=factor * stated[path], low=0.0, high=1.0, unit="1", state="determined")
                 for path, factor in moved.items()}
    told = wording.strained(replace(result, rig=rig, constants=constants))
    assert told == ("Re-fitted, motor inertia is 32 % more (2.8 sigma) and motor gain is 20 % less (2.2 sigma) than "
                    "the rig file says.")
    assert wording.far_off(replace(result, rig=rig, constants=constants)) == ""
    moved = {path: one.model_copy(update={"value": 2.0 * one.value}) for path, one in constants.items()}
    far = replace(result, rig=rig, constants=moved)
    assert wording.far_off(far) == "motor inertia is 164 % more than the rig file says, 9.7 sigma"
    lacks = Disturbance(nominal=0.2, refitted=0.004, extended=0.0)
    missing = result.diagnosis.model_copy(update={"disturbance": lacks})
    sentence = wording.verdict_sentence(missing, rig, wording.far_off(far))
    assert ("wrong: with its constants re-fitted (motor inertia is 164 % more than the rig file says, 9.7 sigma) no "
            "torque is missing") in sentence and "but little" not in sentence
    assert wording.far_off(replace(result, rig=rig, constants={})) == ""
    cause = Cause(effect="parameter:motor.inertia", at="", probability=0.9, parameters={})
    said = result.diagnosis.model_copy(update={"causes": [cause]})
    assert "inertia" not in wording.strained(replace(result, rig=rig, constants=constants, diagnosis=said))
    assert wording.strained(replace(result, rig=rig, constants={})) == ""
    out = io.StringIO()
    print_diagnosis(replace(result, rig=rig, constants=constants), Console(file=out, width=300))
    assert told in out.getvalue()


def test_what_re_fitting_does_is_not_said_of_the_causes() -> None:
    result = made.result()
    refit = result.refitted("encoder")
    one = result.comparisons[0]
    assert replace(result, comparisons=[one]).refitted("encoder") == pytest.approx(one.errors("encoder")[1])
    told = wording.beyond(replace(result, diagnosis=result.diagnosis.model_copy(update={"gain": Gain(
        held_out=["a"], encoder=ChannelGain(nrmse_before=2.0 * refit, nrmse_after=0.8 * refit))})))
    assert told == [f"Angle error: {wording.percent(2.0 * refit)} with the rig file as it is, {wording.percent(refit)} "
                    f"with its constants re-fitted, {wording.percent(0.8 * refit)} with the causes. Re-fitting alone "
                    "does 83 % of that, the causes the rest."]
    out = io.StringIO()
    print_diagnosis(result, Console(file=out, width=300))
    for text in (out.getvalue(), report_html(result)):
        assert all(sentence in text for sentence in wording.beyond(result)) and wording.beyond(result)
    assert wording.beyond(made.result("unexplained")) == []


def test_where_a_test_was_repeated_its_runs_difference_stands_beside_the_error() -> None:
    result = made.result()
    rows = result.diagnosis.gain.runs
    rows[0].repeats.update(encoder=0.0123, accel=0.234)
    out = io.StringIO()
    print_diagnosis(result, Console(file=out, width=160))
    for text in (out.getvalue(), report_html(result)):
        assert "1.2 %" in text and "23 %" in text and "between repeats" in text.lower()
    rows[0].repeats.clear()
    out = io.StringIO()
    print_diagnosis(result, Console(file=out, width=160))
    for text in (out.getvalue(), report_html(result)):
        assert "between repeats" not in text.lower()


def test_a_steps_figures_stand_beside_what_repeats_of_it_differ_by() -> None:
    measures = {"overshoot_percent": 24.0, "rise_time": 0.164, "settling_time": None}
    assert wording.step_words(measures, {"overshoot_percent": 1.44, "settling_time": 0.2, "encoder": 0.01}) == \
        "24.0 ± 1.4 %, 0.164 s, not settled"
    assert wording.step_words({}, {"overshoot_percent": 1.0}) == "–"
