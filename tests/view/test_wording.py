"""Numbers and sentences that people read."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from station.diagnose.result import Diagnosis, Estimate, Gain, RankedCause, Wrong
from station.view import wording
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
    ("explained", 1.02, "all"), ("partly_explained", 1.02, "nearly all"), ("explained", 0.93, "93 %"),
    ("partly_explained", 0.93, "93 %"), ("explained", -0.1, "none")])
def test_the_share_that_is_gone_and_the_verdict_say_the_same(verdict: str, fraction: float, words: str) -> None:
    gain = Gain(held_out=["one"], explained_fraction=fraction)
    assert wording.explained(Diagnosis(verdict=verdict, gain=gain)) == words


def test_odds_never_claim_certainty() -> None:
    assert wording.probability(0.99999) == "> 99.9 %"
    assert wording.probability(1e-9) == "< 0.1 %"
    assert wording.probability(0.983) == "98 %"


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
    ("ambiguous", "cannot tell whether it is Coulomb friction at the motor, Stribeck friction at the motor or "),
    ("unexplained", "gets something wrong, and no cause known here is named by most resamples"),
    ("nothing_missing", "Nothing is missing"), ("not_enough_data", "not enough")])
def test_each_verdict_is_one_plain_sentence(verdict: str, words: str) -> None:
    result = made.result(verdict)
    sentence = wording.verdict_sentence(result.diagnosis, result.rig)
    assert words in sentence
    assert sentence.endswith(".") and sentence.count(". ") == 0


def test_a_settling_that_never_comes_says_so() -> None:
    item = Wrong(run="a", channel="encoder", measure="settling_time", simulated=None, measured=1.25)
    assert wording.measure(item) == ("angle settling time", "never", "1.25 s")


def test_a_candidate_without_a_note_loses_by_its_numbers() -> None:
    first = RankedCause("a", "motor", 0.9, 500.0, 0.4, {})
    assert "does not help" in wording.why_lost(RankedCause("b", "motor", 0.01, 400.0, -0.1, {}), first, False)
    assert "100 below" in wording.why_lost(RankedCause("b", "motor", 0.01, 400.0, 0.1, {}), first, False)
    assert wording.why_lost(first, first, True) == "named as a cause"
    assert "too few resamples name it" in wording.why_lost(first, first, False)


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
                  "held out",
                  "Next: station run pulse --port PORT --rig RIG --amplitude 25 --duration 2 --out pulse-25.mcap"):
        assert words in out.getvalue(), words
