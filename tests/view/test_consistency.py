"""No two sentences of a report or of the terminal contradict each other, whatever a diagnosis finds."""

from __future__ import annotations

import io
import itertools
import re
from dataclasses import replace

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from station.diagnose.result import (
    Cause,
    ChannelGain,
    DiagnosisResult,
    Disturbance,
    Estimate,
    NextExperiment,
    RankedCause,
    Reason,
    Rival,
)
from station.diagnose.thresholds import OUTSIDE, STABLE
from station.view import wording
from station.view.report import report_html
from station.view.terminal import print_diagnosis
from tests.view import made
from tests.view.test_report import Page

NOISE_LEFT = r"only noise and the rig's stated uncertainty remain|what is left is noise|leaves noise alone"
MORE_LEFT = r"more than noise (remains|is left)"
NO_CAUSE = r"No cause is named|no cause known here is named|Nothing is missing|These runs are not enough"
APART = [
    (NOISE_LEFT, MORE_LEFT),
    (MORE_LEFT, r"(?<!nearly )\ball of the error above the noise is gone"),
    (MORE_LEFT, r"within the uncertainty of the fits"),
    (NOISE_LEFT, r"nearly all of the error|% of the error above the noise is gone(?!, the rest within the uncerta)"),
    (r"comes closer on the whole", r"error of whole runs is not smaller"),
    (NO_CAUSE, r"with that put right|What the causes? buys?\b|named as a cause|with the causes?\.|% probable, named in|"
               r"The cause changes|After: the causes added|cannot tell whether"),
    (NO_CAUSE, r"of the error above the noise is gone|error of whole runs is not smaller"),
    (r"Nothing is missing", r"What the simulation gets wrong|leaves out|has a wrong|cannot tell"),
    (r"None is needed for this verdict", r"cannot tell|cannot settle|" + MORE_LEFT + r"|are not enough|station run "),
    (r"None was worked out", r"only noise and the rig's stated uncertainty|Nothing is missing|station run "),
    (r"of this station's tests would decide it", r"station run [a-z]|None is needed"),
    (r"The first candidate|What the first candidate buys", r"with that put right|What the causes? buys?\b"),
]
"""Pairs of claims of which a reader may meet one, never both."""

CAUSES = (("coulomb_friction", "motor"), ("dead_zone", "amplifier"), ("parameter:tip.mass", ""))
shares = st.sampled_from([0.02, 0.27, 0.5, 0.8, 0.93, 0.996, 0.99999])
fractions = st.sampled_from([None, -0.4, 0.0, 0.003, 0.48, 0.93, 0.996, 1.0, 1.3])


@st.composite
def results(draw: st.DrawFn) -> DiagnosisResult:
    """Diagnoses as their rules allow them: which causes are stated, by what share, and what follows, is drawn."""
    verdict = draw(st.sampled_from(sorted(wording.VERDICTS)))
    base = made.result(verdict, runs=1)
    outside = draw(st.sampled_from([0.0, OUTSIDE])) if verdict == "ambiguous" else base.diagnosis.outside
    named = verdict in ("explained", "partly_explained", "ambiguous")
    causes = []
    for effect, at in draw(st.lists(st.sampled_from(CAUSES), min_size=1, max_size=3, unique=True)) if named else []:
        stability = draw(shares if verdict == "ambiguous" else st.floats(STABLE, 1.0))
        probability, rival = draw(shares), draw(st.booleans())
        state = draw(st.sampled_from(["determined", "at_bound", "traded_off", "not_excited"]))
        elsewhere = [Rival(effect=effect, at="base", probability=0.3 * probability)] * (
            at == "motor" and draw(st.booleans()))
        causes.append(Cause(
            effect=effect, at=at, probability=probability, stability=stability,
            parameters={"torque" if at else "value": Estimate(value=0.03, low=0.02, high=0.04, unit="", state=state)},
            rivals=[*[Rival(effect="quadratic_drag", at="base", probability=0.5 * (1.0 - probability))] * rival,
                    *elsewhere]))
    tests = [NextExperiment(test={"kind": "pulse", "amplitude": 25}, why="they differ by 31 counts"),
             NextExperiment(test=None, why="no test here parts them"), None]
    wanted = draw(st.sampled_from(tests[-1:] if verdict in ("explained", "nothing_missing") else tests))
    before, after = draw(shares), draw(shares)
    gain = base.diagnosis.gain.model_copy(update={
        "explained_fraction": draw(fractions),
        "encoder": ChannelGain(nrmse_before=before, nrmse_after=after if named else before)})
    ranking = [RankedCause(c.effect, c.at, c.probability, 100.0, draw(st.sampled_from([None, -0.1, 0.2])),
                           reason=Reason("named")) for c in causes]
    tried = draw(st.sampled_from(["", "by an equivalence", "as part of coulomb_friction@motor + torque_ripple@motor"]))
    ranking += [RankedCause("quadratic_drag", "base", draw(shares), 90.0, draw(st.sampled_from([None, -0.1])),
                            reason=Reason(draw(st.sampled_from(["likely" if causes else "leads", "left_out",
                                                                "explains_less", "no_better"])), 10.0)),
                RankedCause("torque_ripple", "motor", 0.01, 101.0, None, tried, reason=Reason("open", tried=tried))]
    missing = draw(st.sampled_from([None, Disturbance(nominal=0.3, refitted=0.2, extended=0.1)]))
    notes = ["step-kp2: encoder is left with more than noise over the whole run"] * bool(outside)
    diagnosis = base.diagnosis.model_copy(update={"causes": causes, "outside": outside, "gain": gain,
                                                  "next_experiment": wanted,
                                                  "disturbance": missing})
    comparisons = base.comparisons if draw(st.booleans()) else []
    return replace(base, diagnosis=diagnosis, ranking=ranking, notes=notes, comparisons=comparisons, draw=list)


def terminal(result: DiagnosisResult) -> str:
    out = io.StringIO()
    print_diagnosis(result, Console(file=out, width=2000))
    return re.sub(r"\s+", " ", out.getvalue())


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(results())
def test_no_two_sentences_contradict_each_other(result: DiagnosisResult) -> None:
    sentence = wording.verdict_sentence(result.diagnosis, result.rig)
    for text in (Page(report_html(result)).text, terminal(result)):
        assert sentence in text
        for first, second in APART:
            one, other = re.search(first, text), re.search(second, text)
            assert not (one and other), f"{one and one[0]!r} beside {other and other[0]!r}: {sentence}"


@settings(max_examples=20, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(results())
def test_what_is_not_sure_says_where_the_rest_of_its_probability_lies(result: DiagnosisResult) -> None:
    text = Page(report_html(result)).text
    kept = result.diagnosis.outside
    told = f"{wording.probability(OUTSIDE)} is kept for something that acts like these causes and is none" in text
    assert told == bool(kept and result.diagnosis.causes)
    for cause in result.diagnosis.causes:
        head = f"{wording.probability(cause.probability)} probable"
        assert head in text
        rest = 1.0 - cause.probability - kept
        assert (f"The other {wording.probability(rest)}: sets of causes without it" in text) or rest < 0.005
        for rival in cause.rivals:
            share = wording.probability(rival.probability)
            if rival.effect == cause.effect:
                assert f"Instead of at the motor it may act at the base ({share})" in text
            elif rest >= 0.005:
                assert f"drag at the base ({share})" in text


def test_the_sentence_on_what_remains_agrees_with_its_table() -> None:
    """Over all verdicts, scatters and answers of the tests."""
    for verdict, larger in itertools.product(wording.VERDICTS, (0, 1, 10)):
        said = wording.remains_sentence(made.result(verdict, runs=1).diagnosis, larger, 10)
        assert ("more than noise is left" in said) == (verdict in ("partly_explained", "unexplained"))
        assert (f"{larger} of 10 residuals {'is' if larger == 1 else 'are'} larger" in said) == (larger > 0)
    for large, white, followed in itertools.product((True, False), (True, False), (0, 3)):
        words = wording.residual_words(large, white, followed)
        assert ("larger than the noise" in words and "no larger" not in words) == large
        assert words != "noise" or (white and not followed)
        assert ("follows the command" in words) == (followed > 0 and large)


def test_the_pairs_catch_what_stood_in_an_earlier_report() -> None:
    """A verdict of more that remains beside an error that is all gone."""
    text = "it comes closer, but more than noise remains. 2 runs; all of the error above the noise is gone."
    assert any(re.search(a, text) and re.search(b, text) for a, b in APART)
    assert not any(re.search(a, fine) and re.search(b, fine) for a, b in APART
                   for fine in (text.replace("; all", "; nearly all"),))
