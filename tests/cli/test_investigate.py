"""investigate from the command line; and the next experiment as a line that can be typed."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from station.cli.investigate import Folder, first_test
from station.device.port import open_port
from station.diagnose.result import Choice, NextExperiment
from station.diagnose.trials import Trial, trials
from station.errors import UsageError
from station.model.beam import REAL_ELEMENTS
from station.rig import load_rig
from station.runs import load_run
from station.view import wording
from tests.view import made

SFLR = load_rig("sflr")
PULSE = {"kind": "pulse", "amplitude": 60.0, "width": 0.1, "duration": 2.0, "rest": 0.2,
         "controller": {"kind": "open"}}
FIRST = "step:amplitude=40,duration=1.2,controller=lead"


@pytest.fixture
def diagnosed(monkeypatch):
    """The diagnosis made up, so that the loop alone is tried; returns the numbers of runs it was asked for."""
    asked = []

    def diagnose(rig, runs, effort="full", progress=None):
        asked.append([run.name for run in runs])
        assert effort == "quick" and progress is not None
        found = made.result("explained", rig)
        for cause in found.diagnosis.causes:
            cause.probability = 0.99
        plan = NextExperiment(test=PULSE, why="the rivals differ here")
        object.__setattr__(found, "choose", lambda: Choice(plan=plan))
        return found
    monkeypatch.setattr("station.diagnose.diagnose.diagnose", diagnose)
    return asked


def test_it_tests_and_diagnoses_until_decided(station, tmp_path, diagnosed):
    out = tmp_path / "found"
    ended = station("investigate", "--port", "sim://sflr?noise=0.5", "--rig", "sflr", "--out", out, "--first", FIRST,
                    "--effort", "quick")
    assert ended.status == 0, ended.err
    names = ["01-step-lead", "02-pulse-open", "03-pulse-open"]
    assert diagnosed == [names[:1], names[:2], names]
    assert {path.name for path in out.iterdir()} == {"runs", "diagnosis.json", "extended_rig.toml", "report.html"}
    assert [load_run(out / "runs" / f"{name}.mcap").name for name in names] == names
    first = load_run(out / "runs" / "01-step-lead.mcap")
    assert first.metadata.test["amplitude"] == 40.0 and first.metadata.controller["kind"] == "lead"
    assert json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))["verdict"] == "explained"
    assert load_rig(out / "extended_rig.toml").effects
    rows = [line for line in ended.out.splitlines() if line.startswith(("01-", "02-", "03-"))]
    assert len(rows) == 3 and all("Coulomb friction at the motor 99 %" in row for row in rows)
    assert ended.out.count("next: pulse 60 (open): the rivals differ here") == 2 and "\nDecided: " in ended.out


def test_programs_are_told_the_runs_and_the_diagnosis_alone(station, tmp_path, diagnosed):
    ended = station("investigate", "--port", "sim://sflr", "--rig", "sflr", "--out", tmp_path / "found",
                    "--first", FIRST, "--effort", "quick", "--json", "-")
    assert ended.status == 0, ended.err
    found = json.loads(ended.out)
    assert found["outcome"] == "decided" and found["diagnosis"]["verdict"] == "explained"
    assert [Path(run["file"]).stem for run in found["runs"]] == diagnosed[-1]
    assert "next: pulse 60 (open)" in ended.err


def test_it_chooses_the_first_test_and_diagnoses_in_earnest(station, tmp_path):
    out, fine = tmp_path / "found", tmp_path / "fine.toml"
    fine.write_text(load_rig("sflr").with_elements(REAL_ELEMENTS).to_toml(), encoding="utf-8")
    ended = station("investigate", "--port", f"sim://sflr?rig={fine}&noise=0.5&seed=1", "--rig", "sflr", "--out", out,
                    "--budget", "1", "--effort", "quick")
    assert ended.status == 0, ended.err
    (run,) = (out / "runs").glob("*.mcap")
    found = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    asked = found["next_experiment"]["test"]
    assert found["verdict"] == "nothing_missing"
    another = Trial({key: value for key, value in asked.items() if key != "controller"}, asked["controller"])
    assert not another.repeats([load_run(run)])
    assert "The budget is spent: 1 run is all" in ended.out and "\nNext: station run " in ended.out
    assert 'id="figure-next"' in (out / "report.html").read_text(encoding="utf-8")


def test_a_cable_pulled_on_the_way_keeps_what_was_found(station, tmp_path, diagnosed):
    out = tmp_path / "found"
    ended = station("investigate", "--port", "sim://sflr?unplug_after=800", "--rig", "sflr", "--out", out, "--first",
                    FIRST, "--effort", "quick")
    assert ended.status == 1 and "sim://sflr" in ended.err.splitlines()[-1]
    assert len(diagnosed) == 1 and (out / "report.html").exists() and (out / "diagnosis.json").exists()
    assert len(load_run(out / "runs" / "01-step-lead.mcap")) == 600
    assert 500 < len(load_run(out / "runs" / "02-pulse-open.mcap")) < 1000


def test_ctrl_c_keeps_all_runs_and_the_last_diagnosis(station, tmp_path, diagnosed, monkeypatch):
    out = tmp_path / "found"
    from station.diagnose import diagnose as module
    plain = module.diagnose

    def interrupted(rig, runs, *rest):
        if len(runs) == 2:
            raise KeyboardInterrupt
        return plain(rig, runs, *rest)
    monkeypatch.setattr(module, "diagnose", interrupted)
    ended = station("investigate", "--port", "sim://sflr", "--rig", "sflr", "--out", out, "--first", FIRST,
                    "--effort", "quick")
    assert ended.status == 130 and "Traceback" not in ended.err
    assert len(list((out / "runs").glob("*.mcap"))) == 2
    assert (out / "report.html").exists() and (out / "diagnosis.json").exists()


@pytest.mark.parametrize(("options", "status", "named"), [
    (["--port", "sim://nowhere"], 2, "nowhere"), (["--first", "hop"], 2, "hop"),
    (["--first", "step:size=3"], 2, "size"), (["--first", "step:amplitude=big"], 2, "big"),
    (["--first", "step:amplitude"], 2, "amplitude"), (["--first", "step:controller=magic"], 2, "magic"),
    (["--budget", "0"], 2, "budget")])
def test_wrong_use_leaves_no_folder(station, tmp_path, options, status, named):
    out = tmp_path / "found"
    ended = station("investigate", *(["--port", "sim://sflr"] if "--port" not in options else []), "--rig", "sflr",
                    "--out", out, *options)
    assert ended.status == status and named in ended.one_line()
    assert not out.exists()


def test_a_folder_with_files_in_it_is_left_alone(station, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    ended = station("investigate", "--port", "sim://sflr", "--rig", "sflr", "--out", tmp_path)
    assert ended.status == 1 and "holds files" in ended.one_line()
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_the_first_test_is_read_like_the_options_of_run():
    assert first_test("pulse-train:pulses=4", SFLR) == {"kind": "pulse_train", "pulses": 4.0,
                                                        "controller": {"kind": "open"}}
    assert first_test("sweep:spacing=log,f0=0.3", SFLR)["spacing"] == "log"
    with pytest.raises(UsageError, match="no accelerometer"):
        first_test("step:controller=lead-accel", SFLR.model_copy(update={"accelerometer": None}))


EVERY = trials(SFLR, [("torque_ripple", "motor")])
KINDS = {(t.test["kind"], t.controller["kind"], t.controller.get("gain")): t for t in EVERY}


@pytest.mark.parametrize("trial", KINDS.values(), ids=lambda t: f"{t.test['kind']}-{t.controller['kind']}")
def test_the_line_that_is_printed_runs_the_very_test(station, tmp_path, monkeypatch, trial):
    monkeypatch.chdir(tmp_path)
    asked = trial.complete()
    words = shlex.split(wording.run_command(asked, port="sim://sflr", rig="sflr"))
    assert words[0] == "station"
    ended = station(*words[1:])
    assert ended.status == 0, ended.err
    run = load_run(tmp_path / words[words.index("--out") + 1])
    assert run.metadata.controller == asked.pop("controller")
    assert {key: value for key, value in run.metadata.test.items() if key != "second"} == asked


def test_what_the_station_cannot_run_is_told_in_words():
    assert wording.run_command({"kind": "dance", "amplitude": 3}) == "dance, amplitude 3"
    own = {"kind": "step", "amplitude": 5.0, "controller": {"kind": "lead", "gain": 1.0, "zero": 2.0, "pole": 3.0}}
    assert "--controller lead --gain 1 --zero 2 --pole 3" in wording.run_command(own)
    own["controller"] = {"kind": "lead_accel", "gain": 1.0}
    assert "--controller CONTROLLER.toml" in wording.run_command(own)


def test_its_tests_are_answered_as_late_as_the_line_needs(tmp_path):
    kept = Folder(tmp_path / "out", load_rig("sflr"), answer_ticks=2)
    kept.make()
    with open_port("sim://sflr") as line:
        run = kept.run(line, {"kind": "step", "amplitude": 50.0, "duration": 0.8}, {"kind": "p", "gain": 1.0})
    assert run.metadata.command_row == -2 and run.metadata.entries()["answer_ticks"] == 2
