"""simulate, compare, fit and bode from the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import typer

from station.cli.models import app, comparison_table
from station.fit.estimate import HELD
from station.rig import builtin_rigs, load_rig
from station.runs import Run, export_run, load_run
from station.runs.store import file_hash
from tests.cli.conftest import step_run
from tests.measured import measured_log


def test_simulate_does_the_test_of_a_run_on_another_rig(station, step, tmp_path):
    same, other = tmp_path / "same.mcap", tmp_path / "other.csv"
    heavy = tmp_path / "heavy.toml"
    heavy.write_text(builtin_rigs()["sflr"].replace("inertia = 0.00131777", "inertia = 0.01"))
    assert station("simulate", "--rig", "sflr", "--like", step, "--out", same).status == 0
    assert station("simulate", "--rig", heavy, "--like", step, "--out", other).status == 0
    measured = load_run(step)
    assert np.array_equal(load_run(same).encoder, measured.encoder)
    assert not np.array_equal(load_run(other).encoder, measured.encoder)
    assert load_run(other).metadata.rig["motor"]["inertia"] == 0.01


def test_compare_has_the_form_of_the_contract(station, step):
    found = json.loads(station("compare", "--rig", "sflr", step, "--json", "-").out)
    assert set(found) == {"runs"}
    one = found["runs"][0]
    assert set(one) == {"run", "encoder", "accel", "measured", "simulated"}
    assert one["run"] == "step"
    assert one["encoder"]["nrmse"] < 0.01 and one["accel"]["nrmse"] < 0.05
    assert set(one["measured"]) == {"overshoot_percent", "settling_time"}
    assert one["measured"]["overshoot_percent"] == pytest.approx(one["simulated"]["overshoot_percent"], abs=2.1)


def test_compare_says_of_a_closed_loop_without_a_controller_that_it_is_predicted(station, tmp_path):
    run = step_run()
    for name, known, said in (("unknown", {"kind": "unknown"}, True), ("named", {"kind": "p", "gain": 2.0}, False)):
        metadata = run.metadata.model_copy(update={"controller": known})
        export_run(Run(name, metadata=metadata, **run.columns()), tmp_path / f"{name}.csv")
        ended = station("compare", "--rig", "sflr", tmp_path / f"{name}.csv")
        told = [line for line in ended.err.splitlines() if "does not say what closed its loop" in line]
        assert ended.status == 0 and len(told) == said
        assert not said or all(word in told[0] for word in ("predicted 0.5 s ahead", "# controller = ", "unknown.csv"))
        (found,) = json.loads(station("compare", "--rig", "sflr", tmp_path / f"{name}.csv", "--json", "-").out)["runs"]
        assert found["measured"] and bool(found["simulated"]) != said, "no loop answered the step"
    wrong = run.metadata.model_copy(update={"controller": {"kind": "p", "gain": 20.0}})
    export_run(Run("wrong", metadata=wrong, **run.columns()), tmp_path / "wrong.csv")
    told = station("compare", "--rig", "sflr", tmp_path / "wrong.csv").err
    assert "commands are not those of the controller that the log names" in told and "predicted 0.5 s ahead" in told
    opened = Run("open", run.t, run.command, run.command, run.encoder, run.accel)
    export_run(opened, tmp_path / "open.csv")
    assert "what closed its loop" not in station("compare", "--rig", "sflr", tmp_path / "open.csv").err


def test_a_log_with_a_controller_that_there_is_not_is_named(station, tmp_path):
    run = step_run()
    metadata = run.metadata.model_copy(update={"controller": {"kind": "p", "gain": 2.0, "integral": 1.0}})
    export_run(Run("odd", metadata=metadata, **run.columns()), tmp_path / "odd.csv")
    ended = station("compare", "--rig", "sflr", tmp_path / "odd.csv")
    assert ended.status == 1 and "odd: metadata controller.integral: unknown key for kind 'p'" in ended.one_line()
    assert "leave it out" in ended.one_line()


@pytest.mark.parametrize("kind", ["step", "pulse"])
def test_a_test_of_the_simulated_rig_compares_to_its_own_rig_by_nothing(station, tmp_path, kind):
    log, made = tmp_path / f"{kind}.mcap", tmp_path / "made.csv"
    assert station("run", kind, "--port", "sim://sflr?noise=0", "--rig", "sflr", "--amplitude", 60, "--out",
                   log).status == 0
    assert station("simulate", "--rig", "sflr", "--like", log, "--out", made).status == 0
    found = json.loads(station("compare", "--rig", "sflr", log, made, "--json", "-").out)["runs"]
    assert [run[channel]["nrmse"] for run in found for channel in ("encoder", "accel")] == [0.0] * 4


def test_a_run_with_lost_samples_is_compared_on_the_rows_that_it_has(station, tmp_path):
    whole = step_run()
    kept = np.delete(np.arange(len(whole)), [40, 90, 91])
    cut = Run(name="cut", n=kept, metadata=whole.metadata, **{
        name: values[kept] for name, values in whole.columns().items()})
    export_run(cut, tmp_path / "cut.csv")
    found = json.loads(station("compare", "--rig", "sflr", tmp_path / "cut.csv", "--json", "-").out)["runs"][0]
    assert found["encoder"]["nrmse"] == 0.0 and found["accel"]["nrmse"] == 0.0
    made = tmp_path / "made.csv"
    assert station("simulate", "--rig", "sflr", "--like", tmp_path / "cut.csv", "--out", made).status == 0
    assert np.array_equal(load_run(made).encoder, whole.encoder)


def test_compare_refuses_a_run_of_another_rate(station, step, tmp_path):
    slow = tmp_path / "slow.toml"
    slow.write_text(builtin_rigs()["sflr"].replace("sample_rate = 500.0", "sample_rate = 250.0"))
    ended = station("compare", "--rig", slow, step)
    assert ended.status == 1 and f"{step}: sampled at 500 Hz, the rig at 250 Hz: a log wants a row" in ended.one_line()


@pytest.mark.parametrize(("factor", "remedy"), [
    (1000.0, "t looks like ms and must be in s; divide it by 1000"),
    (2e6, "t looks like us and must be in s; divide it by 1000000"),
    (4.0, "a log wants a row for each tick of the loop, or for every other one (500 or 250 Hz); log so, or give")])
def test_a_log_whose_time_is_not_the_rigs_says_what_to_do_before_it_is_imported(station, tmp_path, factor, remedy):
    log, out, run = tmp_path / "odd.csv", tmp_path / "odd.mcap", step_run(rows=400)
    export_run(replace(run, t=factor * run.t), log)
    for command in (["compare", "--rig", "sflr", log], ["import", log, "--rig", "sflr", "--out", out]):
        ended = station(*command)
        assert ended.status == 1 and f"{log}: sampled at " in ended.one_line() and remedy in ended.one_line()
    assert not out.exists()


def test_compare_shows_a_wrong_rig(station, step, tmp_path):
    slow = tmp_path / "slow.toml"
    slow.write_text(builtin_rigs()["sflr"].replace("damping = 0.158669", "damping = 0.4"))
    found = json.loads(station("compare", "--rig", slow, step, "--json", "-").out)["runs"][0]
    assert found["encoder"]["nrmse"] > 0.1
    ended = station("compare", "--rig", slow, step)
    assert "step" in ended.out and "overshoot" in ended.out


@pytest.mark.parametrize(("log", "overshoot"), [("p", 24.0), ("lead", 10.0), ("lead_accel", 21.5)])
def test_compare_measures_the_overshoot_that_the_thesis_measured(station, log, overshoot):
    found = json.loads(station("compare", "--rig", "sflr", measured_log(log), "--json", "-").out)["runs"][0]
    assert found["measured"]["overshoot_percent"] == pytest.approx(overshoot)


def test_fit_finds_a_constant_that_is_off(station, tmp_path):
    runs = []
    for amplitude in (40.0, 90.0):
        path = tmp_path / f"step{amplitude:g}.csv"
        export_run(step_run(amplitude=amplitude, rows=400), path)
        runs.append(path)
    off, fitted = tmp_path / "off.toml", tmp_path / "fitted.toml"
    off.write_text(load_rig("sflr").with_constants({"drive.stiffness": 0.8 * 0.102728}).to_toml())
    hold = [argument for path in load_rig("sflr").constants() if path != "drive.stiffness"
            for argument in ("--hold", path)]
    ended = station("fit", "--rig", off, *runs, *hold, "--starts", 1, "--save-rig", fitted, "--json", "-")
    assert ended.status == 0, ended.err
    (only,) = json.loads(ended.out)["constants"]
    value = only["value"]
    assert only["path"] == "drive.stiffness" and only["low"] < value < only["high"]
    assert value == pytest.approx(0.102728, rel=0.03)
    assert load_rig(fitted).drive.stiffness == pytest.approx(value)


def test_fit_names_a_constant_that_is_not_there(station, step):
    ended = station("fit", "--rig", "sflr", step, "--hold", "wheel.mass")
    assert ended.status == 2 and "wheel.mass" in ended.one_line()


def test_bode_draws_the_rig_and_a_run(station, step, tmp_path):
    out, sweep = tmp_path / "bode.svg", tmp_path / "sweep.mcap"
    assert station("run", "sweep", "--port", "sim://sflr", "--rig", "sflr", "--duration", "10",
                   "--out", sweep).status == 0
    assert station("bode", "--rig", "sflr", "--run", sweep, "--out", out).status == 0
    assert out.read_text(encoding="utf-8").lstrip().startswith("<?xml")
    ended = station("bode", "--rig", "sflr", "--run", step, "--out", out, "--overwrite")
    assert ended.status == 1 and "step" in ended.one_line()
    assert station("bode", "--rig", "sflr", "--out", tmp_path / "bode.txt").status == 2


def test_runs_of_one_name_in_two_folders_are_told_apart(station, tmp_path):
    """In the table and the file of compare, in the recording of view, and in replay."""
    from station.runs.names import names_apart

    files = []
    for folder, size in (("monday", 50.0), ("tuesday", 80.0)):
        (tmp_path / folder).mkdir()
        files.append(tmp_path / folder / "step.csv")
        export_run(step_run(amplitude=size), files[-1])
    out = tmp_path / "found.json"
    ended = station("compare", "--rig", "sflr", *files, "--json", out)
    assert ended.status == 0 and "monday/step" in ended.out and "tuesday/step" in ended.out
    assert [run["run"] for run in json.loads(out.read_text())["runs"]] == ["monday/step", "tuesday/step"]
    ended = station("replay", *files)
    assert [line.split(":")[0] for line in ended.out.splitlines()] == names_apart(files)
    assert station("view", *files, "--save", tmp_path / "both.rrd").status == 0
    ended = station("compare", "--rig", "sflr", files[0], files[0])
    assert ended.status == 2 and "named twice" in ended.one_line()


def test_a_diagnosis_names_runs_of_one_name_by_their_folders(station, tmp_path):
    files = []
    for folder, size in (("monday", 50.0), ("tuesday", 80.0)):
        (tmp_path / folder).mkdir()
        files.append(tmp_path / folder / "step.csv")
        export_run(step_run(amplitude=size), files[-1])
    out, page = tmp_path / "diagnosis.json", tmp_path / "report.html"
    ended = station("diagnose", "--rig", "sflr", *files, "--effort", "quick", "--json", out, "--report", page)
    assert ended.status == 0, ended.err
    runs = json.loads(out.read_text())["runs"]
    assert [run["run"] for run in runs] == ["monday/step", "tuesday/step"]
    assert len({run["file_sha256"] for run in runs}) == 2
    text = page.read_text()
    assert "monday/step" in text and "tuesday/step" in text


def test_a_measure_that_there_is_not_has_no_unit():
    none = {"overshoot_percent": None, "settling_time": None}
    shown = comparison_table("sflr", [{"run": "a", "encoder": {"nrmse": float("nan")}, "measured": none,
                                       "simulated": none | {"overshoot_percent": 40.0}}])
    assert [str(cell) for column in shown.columns for cell in column.cells] == [
        "a", "-", "-", "-", "40 %", "never", "never"]


def test_the_help_says_what_a_fit_holds():
    (hold,) = (parameter for parameter in typer.main.get_command(app).commands["fit"].params
               if parameter.name == "hold")
    assert all(constant in hold.help for constant in HELD)


def test_report_draws_runs_beside_their_own_rig_and_a_second_one(station, step, tmp_path):
    page, again = tmp_path / "page.html", tmp_path / "again.html"
    better = tmp_path / "folder" / "better.toml"
    better.parent.mkdir()
    better.write_text(builtin_rigs()["sflr"])
    ended = station("report", step, "--extended", better, "--out", page)
    assert ended.status == 0 and ended.out == f"{page}: 1 run\n"
    text = page.read_text(encoding="utf-8")
    assert "as rig of the run simulates it" in text and "as better.toml simulates it" in text
    assert str(tmp_path) not in text and file_hash(step) in text
    assert station("report", step, "--rig", "sflr", "--out", again).status == 0
    assert "<h1>1 run: the angle is off by" in again.read_text(encoding="utf-8")
    told = json.loads(station("report", step, "--extended", better, "--out", page, "--overwrite", "--json", "-").out)
    assert told["file"] == str(page)
    assert told["simulated"]["better.toml"] == json.loads(station("compare", step, "--rig", better,
                                                                  "--json", "-").out)["runs"]
    assert "a page's name ends in .html" in station("report", step, "--out", tmp_path / "page.pdf").one_line()
