"""`--json`: every command whose result a program would want has it, in one form, and standard output is its alone."""

from __future__ import annotations

import json
import shlex

import pytest

from station.cli.options import Json
from station.cli.terminal import write_json
from tests.cli.test_examples import EXAMPLES, SLOW, _free, bench, there  # noqa: F401
from tests.cli.test_help import COMMANDS

WITHOUT = {
    "demo": "for people; the folder that it leaves has diagnosis.json",
    "device": "answers until Ctrl-C; its result is the address",
    "view": "opens a window, or writes a recording",
}
HELP = Json.__metadata__[0].help


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_tells_programs_or_says_why_not(name):
    options = {option: parameter for parameter in COMMANDS[name].params for option in parameter.opts}
    assert ("--json" in options) != (name in WITHOUT)
    if "--json" in options:
        assert options["--json"].help == HELP and "--overwrite" in options


QUICK = sorted(set(EXAMPLES) - SLOW - set(WITHOUT) - {"run"})


@pytest.mark.parametrize("name", QUICK)
def test_standard_output_is_one_object(station, there, name):  # noqa: F811
    arguments = shlex.split(EXAMPLES[name])[1:]
    _free(arguments)
    ended = station(*arguments, "--json", "-")
    assert ended.status == 0, ended.err
    found = json.loads(ended.out)
    assert isinstance(found, dict) and found
    if "--out" in arguments:
        assert found["file"] == arguments[arguments.index("--out") + 1]


def test_a_file_gets_the_same_and_people_their_words(station, step, tmp_path):
    out, told = tmp_path / "short.csv", tmp_path / "told.json"
    ended = station("trim", step, "--to", 0.4, "--out", out, "--json", told)
    assert ended.status == 0 and "201 rows" in ended.out
    found = json.loads(told.read_text(encoding="utf-8"))
    assert found["file"] == str(out) and found["rows"] == 201 and found["controller"]["kind"] == "p"


def test_a_test_tells_what_it_counted(station, tmp_path):
    ended = station("run", "step", "--port", "sim://sflr", "--rig", "sflr", "--duration", 0.6, "--out",
                    tmp_path / "s.mcap", "--json", "-")
    found = json.loads(ended.out)
    assert found["rows"] == found["counts"]["samples"] == 300 and found["counts"]["lost"] == 0
    assert found["test"]["kind"] == "step" and found["virtual_time"] is True


def test_a_plan_tells_its_table(station, tmp_path):
    plan = tmp_path / "day.toml"
    plan.write_text('repeats = 2\n[[test]]\nkind = "step"\namplitude = 20\nduration = 0.6\n', encoding="utf-8")
    ended = station("run", "--plan", plan, "--port", "sim://sflr", "--rig", "sflr", "--out", tmp_path / "day",
                    "--json", "-")
    assert ended.status == 0, ended.err
    found = json.loads(ended.out)
    assert found == json.loads((tmp_path / "day" / "results.json").read_text(encoding="utf-8"))
    assert len(found["tests"][0]["runs"]) == 2 and "runs in" in ended.err


def test_what_is_no_number_is_null(tmp_path):
    write_json(tmp_path / "x.json", {"a": float("nan"), "b": [float("inf"), 1.5], "c": tmp_path}, False)
    assert json.loads((tmp_path / "x.json").read_text(encoding="utf-8")) == {
        "a": None, "b": [None, 1.5], "c": str(tmp_path)}


def test_a_file_in_the_way_is_kept_and_nothing_is_run(station, tmp_path):
    told = tmp_path / "told.json"
    told.write_text("mine", encoding="utf-8")
    ended = station("run", "step", "--port", "sim://sflr", "--rig", "sflr", "--out", tmp_path / "s.mcap",
                    "--json", told)
    assert ended.status == 1 and "told.json: exists already" in ended.one_line()
    assert told.read_text(encoding="utf-8") == "mine" and not (tmp_path / "s.mcap").exists()
