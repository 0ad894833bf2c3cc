"""The report's file: its order, its words for every verdict, and that nothing in it comes from elsewhere."""

from __future__ import annotations

import hashlib
import io
import re
import tomllib
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs_version
from rich.console import Console

from station.diagnose.odds import SEED
from station.diagnose.result import BetweenRuns, Choice, Diagnosis, Estimate, Gain, OwnOfRun, Wrong
from station.errors import WorkError
from station.pictures.picture import Evidence
from station.view import wording
from station.view.html import PLOTLY
from station.view.report import SECTIONS, report_html, write_report
from station.view.terminal import print_diagnosis
from station.view.wording import VERDICTS
from tests.view import made


class Page(HTMLParser):
    """Ids in order, text outside scripts and styles, and the addresses that elements name."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.texts: list[str] = []
        self._silent = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        self._silent = tag in ("script", "style")
        self.ids += [known["id"]] if known.get("id") else []
        self.addresses += [str(known[a]) for a in ("src", "href", "action", "data") if a in known]

    def handle_endtag(self, tag: str) -> None:
        self._silent = False

    def handle_data(self, data: str) -> None:
        if not self._silent:
            self.texts.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.texts))


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_has_its_report_in_the_stated_order(verdict: str) -> None:
    page = Page(report_html(made.result(verdict)))
    order = ["verdict", "wrong", "gain", "contents", "cause", "rivals", "parameters", "gains", "stability", "remains",
             "next", "how"]
    assert [i for i in page.ids if i in order] == order
    assert VERDICTS[verdict] in page.text


def test_it_names_no_address_but_its_own_anchors() -> None:
    html = report_html(made.result())
    assert all(a.startswith(("#", "data:")) for a in Page(html).addresses)
    assert html.count("plotly.js (basic - minified) v") == 1
    assert "default-src 'none'" in html


def test_the_numbers_of_the_diagnosis_stand_in_it() -> None:
    text = Page(report_html(made.result())).text
    assert re.search(r"Station \d+\.\d+\.\d+ · rig sflr · 5 runs · effort full · 20\d\d-\d\d-\d\d explained", text)
    for words in ("Coulomb friction at the motor", "0.0305 N m", "0.0291 to 0.0319", "98 %", "8123",
                  "Stribeck friction at the motor", "no better, with two parameters more",
                  "93 % of the error above the noise", "differ by 31 counts", "step-kp1-large", "12 s"):
        assert words in text, words


def test_a_narrow_interval_keeps_its_ends_apart_in_the_table() -> None:
    full = made.result()
    cause = full.diagnosis.causes[0]
    sure = Estimate(value=17.8123, low=17.8012, high=17.8234, unit="N m")
    told = full.diagnosis.model_copy(update={"causes": [cause.model_copy(update={"parameters": {"torque": sure}})]})
    assert "17.812 N m 17.801 to 17.823" in Page(report_html(replace(full, diagnosis=told))).text


def test_every_section_stands_in_the_list_of_contents_and_every_link_leads_somewhere() -> None:
    page = Page(report_html(made.result("partly_explained")))
    links = [a[1:] for a in page.addresses if a.startswith("#")]
    assert links[: len(SECTIONS)] == list(SECTIONS) and set(links) <= set(page.ids)


def test_it_says_how_to_repeat_it() -> None:
    result = made.result()
    text = Page(report_html(result, datetime(2026, 3, 4, 5, 6, tzinfo=UTC))).text
    assert "Written 2026-03-04 05:06 UTC" in text and "--effort full" in text and f"{SEED}" in text
    assert hashlib.sha256(result.rig.to_toml().encode()).hexdigest() in text and "[motor]" in text
    assert all(f"{k:064x}" in text for k in range(5)) and f"numpy {np.__version__}" in text


def test_many_long_runs_stay_below_three_megabytes() -> None:
    full, t = made.result(), np.arange(15_000) / made.RATE

    def long(run: Any) -> Any:
        columns = {name: np.resize(getattr(run, name), len(t)) for name in ("reference", "command", "encoder", "accel")}
        return replace(run, t=t, **columns)
    runs = [replace(c, run=replace(long(c.run), name=f"{c.run.name}-{k}"), before=long(c.before), refit=long(c.refit),
                    after=long(c.after)) for k in range(5) for c in full.comparisons]
    html = report_html(replace(full, comparisons=runs))
    assert "samples the lowest and the highest of each" in html
    assert len(report_html(full).encode()) < 2_000_000 and len(html.encode()) < 3_000_000


def test_the_embedded_script_is_the_one_that_is_stated() -> None:
    """And goes with the package that makes the figures."""
    folder = resources.files("station.view") / "page"
    stated = tomllib.loads((folder / "plotly-basic.toml").read_text(encoding="utf-8"))
    script = (folder / stated["file"]).read_bytes()
    assert hashlib.sha256(script).hexdigest() == stated["sha256"] and stated["file"] == PLOTLY
    assert script[:100].decode().count(f"plotly.js (basic - minified) v{stated['version']}") == 1
    assert get_plotlyjs_version() == stated["version"]
    assert "MIT License" in (folder / "plotly-basic.LICENSE").read_text(encoding="utf-8")


def test_a_value_that_the_runs_do_not_tell_says_so_wherever_it_stands() -> None:
    full = made.result()
    cause = full.diagnosis.causes[0]
    guess = Estimate(value=0.03, low=0.029, high=0.031, unit="N m", state="not_excited")
    told = full.diagnosis.model_copy(update={"causes": [cause.model_copy(update={"parameters": {"torque": guess}})]})
    words = "not told by these runs; known only as it was beforehand"
    assert Page(report_html(replace(full, diagnosis=told))).text.count(words) == 2
    assert words not in Page(report_html(full)).text


def test_noise_is_never_called_a_measured_error() -> None:
    item = Wrong(run="step-kp2", channel="accel", measure="nrmse", simulated=0.31, measured=0.008)
    full = made.result()
    text = Page(report_html(replace(full, diagnosis=full.diagnosis.model_copy(update={"wrong": [item]})))).text
    assert text.count("a right simulation would leave 0.8 %") == 2 and "measured 0.8 %" not in text


def test_stability_has_a_section_with_what_is_asked() -> None:
    noted = replace(made.result(), notes=["in the best set but not stated, for too few resamples name them: "
                                          "dead_zone at amplifier (0.61)"])
    text = Page(report_html(noted)).text
    assert "Coulomb friction at the motor 93 % of the resamples reached" in text
    assert "too few resamples name them: dead zone in the amplifier (0.61)." in text
    low = noted.diagnosis.causes[0].model_copy(update={"stability": 0.5})
    ambiguous = made.result("ambiguous")
    said = replace(ambiguous, diagnosis=ambiguous.diagnosis.model_copy(update={"causes": [low]}))
    assert "50 % of the resamples not reached" in Page(report_html(said)).text


def test_rivals_lose_for_a_stated_reason() -> None:
    text = Page(report_html(made.result())).text
    assert "dead zone in the amplifier 0.3 % 6120 22 % explains less: 2 Δln L is 2003 below the first's" in text
    assert "wrong tip mass < 0.1 % 230 −3.0 % does not help on unseen runs" in text


def test_stability_and_where_the_other_odds_lie_stand_beside_a_cause() -> None:
    text = Page(report_html(made.result())).text
    assert "98 % probable, named in 93 % of the resamples" in text
    assert ("The other 1.8 %: sets of causes without it, among them with Stribeck friction at the motor (1.4 %), "
            "dead zone in the amplifier (0.3 %).") in text


def test_gains_ahead_step_measures_and_the_missing_torque_stand_in_it() -> None:
    text = Page(report_html(made.result())).text
    assert "4.0 % → 1.1 %" in text and "24.0 %, 0.0710 s, 1.15 s" in text and "38.0 %, 0.0660 s, not settled" in text
    assert "31 % of the command's rms torque with the rig file as it is, 22 % with its constants re-fitted, " \
           "4.0 % with the causes." in text
    assert f"{2:064x}" in text and "Effort full." in text


def test_a_run_whose_loop_cannot_be_simulated_is_said_to_be_predicted() -> None:
    known = made.result()
    assert "0.5 s ahead" not in Page(report_html(known)).text
    first, second, third, *others = known.comparisons
    lost = [replace(c, seconds_ahead=0.5, not_closed=why) for c, why in (
        (first, "the log begins in motion"), (second, "it does not say"), (third, "the log begins in motion"))]
    text = Page(report_html(replace(known, comparisons=[*lost, *others]))).text
    told = "predicted 0.5 s ahead of what was read, by the logged command, and not simulated as a whole"
    assert f"{first.run.name}, {third.run.name}: {told}, for the log begins in motion." in text
    assert f"{second.run.name}: {told}, for it does not say." in text


def test_what_is_known_to_be_the_same_stands_beside_the_cause() -> None:
    same = "A late <command> is a late sensor."
    html = report_html(replace(made.result("ambiguous"), equivalences=[same]))
    assert f"{same} No test can tell them apart." in Page(html).text and same not in html
    assert "No test can tell" not in Page(report_html(made.result("ambiguous"))).text


def test_an_error_stands_beside_what_noise_alone_leaves() -> None:
    item = Wrong(run="a", channel="accel", measure="nrmse", simulated=0.31, measured=0.021)
    assert wording.measure(item) == ("acceleration error", "31.0 % of the signal",
                                      "a right simulation would leave 2.1 %")
    assert wording.fact(item)[1] == "31.0 % of the signal, where a right simulation would leave 2.1 %"
    alone = item.model_copy(update={"measured": None})
    assert wording.measure(alone)[2] == "–" and wording.fact(alone)[1] == "31.0 % of the signal"


def test_an_ambiguous_verdict_speaks_of_the_cause_that_has_rivals() -> None:
    result = made.result("ambiguous")
    cause = result.diagnosis.causes[0]
    sure = cause.model_copy(update={"effect": "dead_zone", "at": "amplifier", "rivals": []})
    said = wording.verdict_sentence(result.diagnosis.model_copy(update={"causes": [sure, cause]}), result.rig)
    assert said.startswith("The simulation leaves out dead zone in the amplifier. ")
    assert "whether it is Coulomb friction at the motor" in said


def test_names_from_files_are_escaped_everywhere() -> None:
    html = report_html(made.hostile())
    assert made.HOSTILE not in html
    figures = re.search(r'id="figures">(.*?)</script>', html, re.S)
    assert figures is not None and not set("<>&") & set(figures.group(1))


def test_a_diagnosis_without_runs_still_reads() -> None:
    bare = replace(made.result("not_enough_data"), comparisons=[], ranking=[], draw=list, constants={})
    bare = replace(bare, diagnosis=Diagnosis(verdict="not_enough_data", gain=Gain(held_out=[])))
    text = Page(report_html(bare)).text
    assert "These runs are not enough" in text and "No run could be drawn" in text


def test_a_rig_without_accelerometer_has_one_channel() -> None:
    full = made.result()
    single = [replace(c, run=replace(c.run, accel=None), before=replace(c.before, accel=None)) for c in
              full.comparisons]
    text = Page(report_html(replace(full, comparisons=single))).text
    assert "angle residual" not in text and "acceleration 18 %" not in text


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(WorkError, match=r"report\.html: the folder .*nowhere does not exist"):
        write_report(made.result(), tmp_path / "nowhere" / "report.html")


def test_the_next_experiment_is_a_line_to_type_with_what_it_should_show() -> None:
    full = replace(made.result("ambiguous"), choose=lambda: Choice(prediction=made.prediction()))
    html = report_html(full)
    assert 'id="figure-next"' in html and '"next":{' in html
    assert "station run pulse --port PORT --rig RIG --amplitude 25 --duration 2" in Page(html).text
    settled = replace(full, diagnosis=full.diagnosis.model_copy(update={"next_experiment": None}))
    assert 'id="figure-next"' not in report_html(settled) and '"next":{' not in report_html(settled)


def test_the_loops_figures_are_shown_where_the_log_tells_them() -> None:
    found = made.result()
    assert "How fast samples were answered" not in report_html(found)
    told = {"latency": {"median": 21e-6, "p99": 64e-6, "p999": 1.5e-4, "max": 2.5e-3},
            "counts": {"samples": 1000, "unanswered": 5},
            "histogram": {"edges": [0.0, 20e-6, 50e-6], "counts": [0, 990, 10]}}
    runs = [replace(c, run=replace(c.run, metadata=c.run.metadata.model_copy(update=told if i == 0 else {
        "latency": "fast", "counts": 3}))) for i, c in enumerate(found.comparisons)]
    text = " ".join(Page(report_html(replace(found, comparisons=runs))).texts)
    assert "How fast samples were answered" in text
    assert all(word in text for word in ("21", "64", "150", "2500", "0.5 %", "20: 990, 50: 10"))


def test_runs_that_differ_are_told_beside_the_causes_run_by_run() -> None:
    found = made.result()
    assert "The runs differ" not in Page(report_html(found)).text
    names = [row.run for row in found.diagnosis.gain.runs]
    between = BetweenRuns(share=0.138, constant=0.98, probability={"share": 0.91, "constant": 0.88},
                          stability={"share": 1.0, "constant": 0.93},
                          runs=[OwnOfRun(run=name, share=0.1 * k - 0.15, constant=0.25 * k)
                                for k, name in enumerate(names)])
    differ = replace(found, diagnosis=found.diagnosis.model_copy(update={"between_runs": between}))
    text, out = Page(report_html(differ)).text, io.StringIO()
    assert (f"more or less by 14 % of its command, from −15 % in {names[0]} to 25 % in {names[4]} (91 % probable, "
            "shown by all resamples) and by 0.98 counts of command, from 0") in text
    assert f"to 1.0 in {names[4]} (88 % probable, shown by 93 % of the resamples), as no cause" in text
    assert f"{names[1]} −5.0 % 0.25" in text and f"{names[4]} 25 % 1.0" in text
    print_diagnosis(differ, Console(file=out, width=400))
    assert "(88 % probable, shown by 93 % of the resamples), as no cause with one value can" in out.getvalue()


def test_a_picture_that_cannot_show_gives_its_reason_and_no_figure() -> None:
    none = np.zeros(0)
    lost = Evidence("Torque of the drive", "none", "", "", none, none, note="Not drawn: nobody reads the motor.")
    html = report_html(replace(made.result(), draw=lambda: [lost, made.friction_evidence()]))
    assert "Not drawn: nobody reads the motor." in Page(html).text
    assert "figure-evidence-0" not in html and "figure-evidence-1" in html and '"evidence-0"' not in html
