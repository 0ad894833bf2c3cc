"""The example of an effect of one's own, scripts/own_effect.py: an effect like any other, and a better explanation."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from station.diagnose.candidates import candidates
from station.diagnose.diagnose import diagnose
from station.diagnose.whole_run import settled_run
from station.estimation.dataset import dataset
from station.model.effects import catalogue, load_effects
from station.model.simulate import build, simulate_model
from station.rig import Rig
from station.runs import load_run
from station.runs.run import Run, RunMetadata
from station.view.report import write_report
from station.view.wording import cause_title
from tests.truth import CONTROLLERS, RIGID_AXIS, make_case, pulse_test, step_test
from tests.truth.simulate import Truth

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "own_effect.py"
STOPS = {"stiffness": 4.0, "reach": 0.4}
ALIKE = {"effect": "end_stop", "at": "", "angle": 0.4, "stiffness": 4.0, "damping": 0.0}
"""The independent generator's own stops, which are outside the catalogue."""


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    """The script, its effect in the catalogue as long as these tests last."""
    load_effects(SCRIPT)
    cls = catalogue()["rubber_stops"]
    yield sys.modules[cls.__module__]
    cls.name = ""
    del sys.modules[cls.__module__]


@pytest.fixture(scope="module")
def rig(script) -> Rig:
    return Rig.from_toml(script.RIG)


def test_the_law_is_that_of_the_independent_generator(script, rig):
    model = build(rig.with_effects([script.RubberStops(at="base", **STOPS)]), longest=1e-4)
    for test in (step_test(500.0, "p1", 120.0, 1.2), pulse_test(500.0, 90.0, 0.3, duration=1.2)):
        truth = Truth(RIGID_AXIS, [ALIKE]).run(test.reference, CONTROLLERS[test.controller], rounding=False)
        zero = np.zeros(len(test.reference))
        made = simulate_model(model, Run("x", np.arange(len(zero)) / 500.0, test.reference, test.reference, zero, None,
                                         RunMetadata(controller=CONTROLLERS[test.controller], command_row=-1
                                                     if test.controller != "open" else 0)), rounding=False)
        np.testing.assert_allclose(made.encoder, truth.encoder, atol=0.02)
        assert np.abs(truth.encoder).max() > 0.4 / rig.angle_per_count, "the stops are reached"


def test_stops_that_the_generator_hides_are_named_with_picture_and_words(script, rig, tmp_path):
    tests = [step_test(500.0, "p1", 60.0, 1.2), step_test(500.0, "p1", 110.0, 1.2), step_test(500.0, "p1", -90.0, 1.2),
             pulse_test(500.0, 90.0, 0.3, duration=1.2)]
    hidden = make_case(8020, [ALIKE], tests, nominal=RIGID_AXIS)
    assert ("rubber_stops", "base") in {candidate.key for candidate in candidates(rig)}
    result = diagnose(rig, hidden.runs, effort="quick")
    (cause,) = result.diagnosis.causes
    assert result.diagnosis.verdict == "explained" and (cause.effect, cause.at) == ("rubber_stops", "base")
    for name, value in STOPS.items():
        assert cause.parameters[name].value == pytest.approx(value, rel=0.2)
    assert result.diagnosis.gain.encoder.nrmse_after < 0.1 * result.diagnosis.gain.encoder.nrmse_before
    picture = result.evidence[0]
    assert picture.kind == "angle" and picture.title.endswith("rubber stops") and np.ptp(picture.law_y) > 0.2
    assert cause_title("rubber_stops", "base") == "rubber stops at the base"
    write_report(result, tmp_path / "report.html")
    assert "ubber stops at the base" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_script_measures_the_rig_that_it_hides(script, tmp_path):
    """Its logs are those of the axis with stops, and not of the axis without."""
    runs = [load_run(tmp_path / name) for name in script.measure(tmp_path)]
    assert len({run.metadata.zero_id for run in runs}) == 1
    errors = {}
    for text in (script.RIG, script.HIDDEN):
        data = dataset(Rig.from_toml(text), runs)
        made = [settled_run(data, build(data.rig), r, own) for r, own in enumerate(data.own)]
        errors[text] = [np.abs(run.encoder - one.encoder).max() for run, one in zip(runs, made, strict=True)]
    assert max(errors[script.HIDDEN]) < 2.0 and max(errors[script.RIG]) > 20.0
    said = script.told({"verdict": "unexplained", "causes": [], "gain": {"encoder": {
        "nrmse_before": 0.5, "nrmse_after": 0.25}}})
    assert said == "unexplained; no cause; error on unseen runs 50.0% > 25.0%"


def test_it_has_all_that_an_effect_wants(script):
    cls = catalogue()["rubber_stops"]
    assert cls.telling and cls.experiment and cls.picture == "angle" and cls.absolute == "reach"
