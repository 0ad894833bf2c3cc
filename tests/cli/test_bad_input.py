"""Whatever is wrong with what a command is given: one line that names it, exit 2 or 1, no traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from station.rig import builtin_rigs
from station.runs import Run, export_run
from tests.cli.conftest import step_run

SFLR = builtin_rigs()["sflr"]
RIG_FAULTS = {
    "an unknown key": (SFLR.replace("[motor]", "[motor]\ncolour = 3"), "motor.colour: unknown key"),
    "a misspelt table": (SFLR.replace("[motor]", "[motr]"), "motr: unknown key"),
    "a misspelt key": (SFLR.replace("stiffness = 0.102728", "stifness = 0.102728"), "drive.stifness: unknown key"),
    "an unknown table": (SFLR + "\n[wheel]\nmass = 1.0\n", "wheel: unknown key"),
    "a negative mass": (SFLR.replace("mass = 0.00612610", "mass = -0.1"), "tip.mass"),
    "a beam of no length": (SFLR.replace("length = 0.413544", "length = 0.0"), "beam.length"),
    "too many elements": (SFLR.replace("elements = 4", "elements = 201"), "beam.elements"),
    "text for a number": (SFLR.replace("inertia = 0.00131777", 'inertia = "large"'), "motor.inertia"),
    "not a number": (SFLR.replace("inertia = 0.00131777", "inertia = nan"), "motor.inertia"),
    "a missing table": (SFLR.replace("[amplifier]\nlimit = 200.0", ""), "amplifier: missing"),
    "no TOML": ("name = = 3", "not TOML"),
    "an unknown effect": (SFLR + '\n[[effects]]\neffect = "magic"\nat = "motor"\n', "magic"),
    "33 effects": (SFLR + 33 * '\n[[effects]]\neffect = "coulomb_friction"\nat = "motor"\ntorque = 0.1\n', "effects"),
}


@pytest.mark.parametrize("fault", RIG_FAULTS)
def test_a_rig_file_with(station, step, tmp_path, fault):
    text, named = RIG_FAULTS[fault]
    rig = tmp_path / "bad.toml"
    rig.write_text(text)
    ended = station("simulate", "--rig", rig, "--like", step, "--out", tmp_path / "out.csv")
    assert ended.status == 2
    assert "bad.toml" in ended.one_line() and named in ended.one_line()
    assert not (tmp_path / "out.csv").exists()


def test_a_rig_that_is_nowhere(station, step, tmp_path):
    ended = station("simulate", "--rig", "nowhere.toml", "--like", step, "--out", tmp_path / "out.csv")
    assert ended.status == 2
    assert "nowhere.toml" in ended.one_line() and "sflr" in ended.one_line()


def _csv(rows: list[str]) -> str:
    return "\n".join(["t,reference,command,encoder,accel", *rows]) + "\n"


RUN_FAULTS = {
    "nothing in it": "",
    "no columns": "hello\n",
    "a NaN": _csv(["0.0,0,0,0,0", "0.002,0,0,nan,0", "0.004,0,0,0,0"]),
    "an infinity": _csv(["0.0,0,0,0,0", "0.002,inf,0,0,0", "0.004,0,0,0,0"]),
    "irregular time": _csv(["0.0,0,0,0,0", "0.002,0,0,0,0", "0.009,0,0,0,0", "0.011,0,0,0,0"]),
    "time that stands still": _csv(["0.0,0,0,0,0", "0.0,0,0,0,0", "0.0,0,0,0,0"]),
    "a short row": _csv(["0.0,0,0,0,0", "0.002,0,0", "0.004,0,0,0,0"]),
    "words for numbers": _csv(["0.0,0,0,0,0", "0.002,a,b,c,d", "0.004,0,0,0,0"]),
    "one row": _csv(["0.0,0,0,0,0"]),
    "a header to be evaluated": "# controller = __import__('os').system('true')\n" + _csv(["0,0,0,0,0", "1,0,0,0,0"]),
}


@pytest.mark.parametrize(("text", "words"), [
    ("t;reference;command;encoder\n0,0;0;0;0\n0,002;0;0;0\n", "between semicolons"),
    ("t,reference,command,encoder,encoder\n0,0,0,0,0\n0.002,0,0,0,0\n", "the column 'encoder' stands twice"),
    ("t\treference\tcommand\tencoder\n0\t0\t0\t0\n", "between tabs"),
    ("# kp=1.0\n# t\tn\tu\tv\tu\n0\t0\t0\t0\t0\n", "the column 'u' stands twice"),
    (_csv(["0.0,0,0,0,0", "0.002,0,0,1e9,0"]), "encoder, line 3: 1e+09 counts")])
def test_what_is_wrong_with_a_table_is_named(station, tmp_path, text, words):
    log, out = tmp_path / "bad.csv", tmp_path / "out.mcap"
    log.write_text(text)
    ended = station("import", log, "--out", out)
    assert ended.status == 1 and words in ended.one_line() and "bad.csv" in ended.one_line()
    assert not out.exists()


LINES = {
    "not a number": ("0.002,0,0,left,0", "line 5: 'left' is not a number"),
    "short": ("0.002,0,0", "line 5: 3 fields where 5 are named"),
    "empty": ("", "line 5 is empty"),
    "a NaN": ("0.002,0,0,nan,0", "column encoder, line 5: nan"),
    "irregular": ("0.0029,0,0,0,0", "column t, line 5: irregular time"),
    "an encoder that no arm turns": ("0.002,0,0,1e9,0", "column encoder, line 5: 1e+09 counts"),
}


@pytest.mark.parametrize("fault", LINES)
def test_every_message_counts_the_lines_of_a_text_file_as_an_editor_does(station, tmp_path, fault):
    """Whoever finds the fault: the reader of lines, the check of columns, the clock's, the import."""
    bad, words = LINES[fault]
    rows = ["0.0,0,0,0,0", bad, *(f"{0.002 * i:.3f},0,0,0,0" for i in range(2, 9))]
    log = tmp_path / "bad.csv"
    log.write_text('# rig = "sflr"\n# zero_id = "a"\n' + _csv(rows))
    assert log.read_text().splitlines()[4] == bad
    ended = station("import", log, "--out", tmp_path / "out.mcap")
    assert ended.status == 1 and words in ended.one_line()


def test_a_log_that_ends_early_or_has_gaps_says_so_wherever_it_is_used(station, tmp_path):
    whole, cut, gappy = tmp_path / "whole.mcap", tmp_path / "cut.mcap", tmp_path / "gappy.csv"
    run = step_run(rows=2000)
    export_run(run, whole)
    cut.write_bytes(whole.read_bytes()[:-400])
    kept = [row for row in range(2000) if row not in (60, 61)]
    export_run(Run("gappy", n=kept, metadata=run.metadata,
                   **{name: values[kept] for name, values in run.columns().items()}), gappy)
    for command in (["compare", "--rig", "sflr"], ["replay", "--rig", "sflr"]):
        assert "cut.mcap: the log ends early" in station(*command, cut).err
    assert "gappy.csv: 2 samples are missing" in station("compare", "--rig", "sflr", gappy).err


def test_what_reading_made_of_the_times_is_told_wherever_the_log_is_used(station, tmp_path):
    log, kept, rows = tmp_path / "stamped.csv", tmp_path / "kept.mcap", range(200)
    log.write_text(_csv([f"{(i + 0.1 * (i % 7 - 3)) / 500.0:.6f},0,0,0,0" for i in rows]))
    for command in (["import", "--out", kept], ["export", "--out", tmp_path / "a.csv"],
                    ["simulate", "--rig", "sflr", "--out", tmp_path / "b.csv", "--like"]):
        assert "stamped.csv: the times jitter by up to 3" in station(*command, log).err
    assert "kept.mcap: the times jitter" in station("compare", "--rig", "sflr", kept).err
    assert "the times jitter" in station("runs", tmp_path).out
    log.write_text(_csv([f"{i / 500.0:.6f},0,0,0,0" for i in rows if i != 40]))
    told = station("import", log, "--out", kept, "--overwrite").err
    assert "by the times 1 rows are missing, the first before line 42" in told and "1 samples are missing" in told


@pytest.mark.parametrize("fault", RUN_FAULTS)
def test_a_log_with(station, tmp_path, fault):
    log = tmp_path / "bad.csv"
    log.write_text(RUN_FAULTS[fault])
    ended = station("simulate", "--rig", "sflr", "--like", log, "--out", tmp_path / "out.csv")
    assert ended.status == 1
    assert "bad.csv" in ended.one_line()


def test_a_log_that_is_nowhere(station, tmp_path):
    ended = station("replay", tmp_path / "nowhere.csv")
    assert ended.status == 1 and "nowhere.csv" in ended.one_line()


def test_a_log_that_is_a_folder(station, tmp_path):
    ended = station("replay", tmp_path)
    assert ended.status == 1 and str(tmp_path) in ended.one_line()


def test_bytes_that_are_no_log(station, tmp_path):
    log = tmp_path / "noise.mcap"
    log.write_bytes(bytes(range(256)) * 20)
    ended = station("replay", log)
    assert ended.status == 1 and "noise.mcap" in ended.one_line()


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.95])
def test_a_truncated_log_is_read_to_its_last_record_or_refused(station, tmp_path, share):
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    export_run(step_run(rows=2000), whole)
    data = whole.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    ended = station("export", cut, "--out", tmp_path / "out.csv")
    assert ended.status in (0, 1)
    if ended.status == 1:
        assert "cut.mcap" in ended.one_line()


VIEWS = {"view": ["--save", "out.rrd"], "replay": ["--model", "sflr", "--save", "out.rrd"],
         "diagnose": ["--rig", "sflr", "--report", "out.html"], "bode": ["--rig", "sflr", "--out", "out.svg"],
         "compare": ["--rig", "sflr", "--json", "out.json"]}


@pytest.mark.parametrize("content", [
    None, b"", b"\x89PNG\r\n\x1a\n" + bytes(200), b"<html></html>", b"RRF2" + bytes(64)],
    ids=["missing", "empty", "a picture", "a page", "a recording"])
@pytest.mark.parametrize("view", VIEWS)
def test_a_view_of_no_run_is_one_line_and_leaves_nothing(station, tmp_path, monkeypatch, view, content):
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log.mcap"
    if content is not None:
        log.write_bytes(content)
    ended = station(view, *(["--run"] if view == "bode" else []), log, *VIEWS[view])
    assert ended.status == 1 and "log.mcap" in ended.one_line()
    assert [path.name for path in tmp_path.iterdir() if path != log] == []


@pytest.mark.parametrize(("option", "status"), [("--rig", 2), ("--extended", 2)])
@pytest.mark.parametrize("text", [None, "", "colour = 3"], ids=["missing", "empty", "foreign"])
def test_a_view_with_no_rig_is_one_line_and_leaves_nothing(station, step, tmp_path, option, status, text):
    rig = tmp_path / "other.toml"
    if text is not None:
        rig.write_text(text, encoding="utf-8")
    ended = station("view", step, option, rig, "--save", tmp_path / "out.rrd")
    assert ended.status == status and "other.toml" in ended.one_line()
    assert not (tmp_path / "out.rrd").exists()


def test_a_view_of_a_run_of_another_rate_is_one_line(station, step, tmp_path):
    rig = tmp_path / "fast.toml"
    rig.write_text(SFLR.replace("sample_rate = 500.0", "sample_rate = 800.0"), encoding="utf-8")
    ended = station("view", step, "--rig", rig, "--save", tmp_path / "out.rrd")
    assert ended.status == 1 and "step: sampled at 500 Hz, rig sflr at 800 Hz" in ended.one_line()
    assert not (tmp_path / "out.rrd").exists()


def test_the_page_of_a_folder_that_is_none_is_one_line(station, tmp_path):
    for folder, words in ((tmp_path / "nowhere", "nowhere"), (tmp_path / "file", "file")):
        (tmp_path / "file").write_text("x", encoding="utf-8")
        ended = station("runs", folder, "--html")
        assert ended.status in (1, 2) and words in ended.one_line()


def test_two_runs_of_one_name(station, step, tmp_path):
    (tmp_path / "other").mkdir()
    same = tmp_path / "other" / "step.csv"
    same.write_text(step.read_text())
    ended = station("replay", step, same, "--json", "-")
    assert ended.status == 0
    assert [run["run"] for run in json.loads(ended.out)["runs"]] == [f"{tmp_path.name}/step", "other/step"]


@pytest.mark.parametrize("arguments", [
    ["nonsense"], ["replay"], ["replay", "--nonsense", "x"], ["simulate", "--rig", "sflr"],
    ["replay", "x.csv", "--tolerance", "much"]])
def test_arguments_that_no_command_has(station, arguments):
    ended = station(*arguments)
    assert ended.status == 2
    ended.one_line()


def test_an_ending_that_no_form_has(station, step, tmp_path):
    ended = station("export", step, "--out", tmp_path / "out.docx")
    assert ended.status == 2 and "out.docx" in ended.one_line()


def test_an_output_folder_that_is_nowhere(station, step, tmp_path):
    ended = station("export", step, "--out", tmp_path / "no" / "out.csv")
    assert ended.status == 1 and "does not exist" in ended.one_line()


def test_names_from_files_cannot_command_the_terminal(station, step, tmp_path):
    rig = tmp_path / "evil.toml"
    rig.write_text(SFLR.replace('name = "sflr"', r'name = "\u001b[2J\u001b]0;owned\u0007"'), encoding="utf-8")
    ended = station("simulate", "--rig", rig, "--like", step, "--out", tmp_path / "out.csv")
    assert ended.status == 0
    assert "\x1b" not in ended.out and "\x07" not in ended.out and r"\x1b[2J" in ended.out
    ended = station("replay", tmp_path / "\x1b[31mred.csv")
    assert ended.status == 1 and "\x1b" not in ended.one_line()


def test_a_traceback_is_shown_to_those_who_ask(station, tmp_path, monkeypatch):
    monkeypatch.setenv("STATION_TRACEBACK", "1")
    ended = station("replay", tmp_path / "nowhere.csv")
    assert ended.status == 1 and "Traceback" in ended.err


def test_a_reader_that_goes_away_is_no_error():
    root = Path(__file__).resolve().parents[2]
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run([sys.executable, "-m", "station", "--help"], stdout=writer, stderr=subprocess.PIPE,
                              cwd=root, text=True)
    finally:
        os.close(writer)
    assert done.stderr == ""


@pytest.mark.parametrize(("old", "new", "words"), [
    ("derivative", "derivativ", "controller.derivativ: unknown key for kind 'pid'; controller.derivative: missing"),
    ("1.5", '"1.5"', "controller.gain: a number or a list of numbers is wanted, not '1.5'")])
def test_a_controller_file_names_itself_and_the_key(station, tmp_path, old, new, words):
    file, out = tmp_path / "mine.toml", tmp_path / "out.mcap"
    file.write_text('kind = "pid"\ngain = 1.5\nintegral = 0.8\nderivative = 0.05\nfilter = 0.02\n'.replace(old, new))
    ended = station("run", "step", "--port", "sim://sflr?speed=0", "--rig", "sflr", "--controller", file, "--out", out)
    assert ended.status == 2 and f"mine.toml: {words}" in ended.one_line() and not out.exists()


def test_an_uncertainty_in_percent_is_refused(station, step, tmp_path):
    rig = tmp_path / "mine.toml"
    rig.write_text(SFLR.replace("default = 0.1", "default = 20"))
    ended = station("compare", "--rig", rig, step)
    assert ended.status == 2 and "mine.toml: uncertainty.default: one sigma" in ended.one_line()
    assert "not 20; 0.2 is 20 %" in ended.one_line()
