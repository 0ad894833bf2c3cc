"""Outputs: no file is replaced unasked, an input never."""

from __future__ import annotations

import errno
import importlib
import shutil
from types import SimpleNamespace

import pytest

from station.errors import WorkError
from station.rig import builtin_rigs, load_rig

WRITES = {
    "diagnose": ("--json", "--report", "--save-rig"),
    "compare": ("--json",),
    "fit": ("--save-rig", "--json"),
    "bode": ("--out",),
    "view": ("--save",),
    "report": ("--out",),
    "simulate": ("--out",),
    "export": ("--out",),
    "import": ("--out",),
    "trim": ("--out",),
    "recover": ("--out",),
    "replay": ("--json",),
}
ENDINGS = {"--report": ".html", "--save-rig": ".toml", "--json": ".json", "--out": ".csv", "--save": ".rrd"}


@pytest.fixture
def arguments(step, tmp_path):
    """What each command wants beside its output."""
    rig = tmp_path / "my_rig.toml"
    rig.write_text(builtin_rigs()["sflr"], encoding="utf-8")
    log = tmp_path / "log.csv"
    shutil.copy(step, log)
    return {name: {"simulate": ["--like", log, "--rig", rig], "bode": ["--rig", rig, "--run", log],
                   "export": [log], "trim": [log], "recover": [log]}.get(name, [log, "--rig", rig])
            for name in WRITES}


@pytest.mark.parametrize(("name", "option"), [(name, option) for name, options in WRITES.items() for option in options])
def test_a_file_that_is_there_stays_as_it_is(station, arguments, tmp_path, name, option):
    there = tmp_path / f"there{ {'bode': '.svg', 'report': '.html'}.get(name, ENDINGS[option])}"
    there.write_bytes(b"mine")
    ended = station(name, *arguments[name], option, there)
    assert ended.status == 1 and f"{there}: exists already; --overwrite replaces it" in ended.one_line()
    assert there.read_bytes() == b"mine"


@pytest.mark.parametrize(("name", "option"), [
    (name, option) for name, options in WRITES.items() if name not in ("diagnose", "fit") for option in options])
def test_a_file_that_comes_while_a_command_works_stays(station, arguments, tmp_path, monkeypatch, name, option):
    """What is asked before the work began found nothing there."""
    for module in ("files", "models", "views"):
        monkeypatch.setattr(importlib.import_module(f"station.cli.{module}"), "need_outputs", lambda *_, **__: None)
    there = tmp_path / f"there{ {'bode': '.svg', 'report': '.html'}.get(name, ENDINGS[option])}"
    there.write_bytes(b"mine")
    if name == "recover":
        arguments[name] = [tmp_path / "log.mcap"]
        assert station("export", tmp_path / "log.csv", "--out", tmp_path / "log.mcap").status == 0
    ended = station(name, *arguments[name], option, there)
    assert ended.status == 1 and f"{there}: " in ended.err.splitlines()[-1]
    assert there.read_bytes() == b"mine"


@pytest.mark.parametrize("option", ["json", "report", "rig"])
def test_a_file_that_comes_while_a_diagnosis_works_stays(tmp_path, monkeypatch, option):
    from station.cli.diagnosis import save
    from station.view import report

    monkeypatch.setattr(report, "report_html", lambda result: "page")
    result = SimpleNamespace(extended_rig=load_rig("sflr"), diagnosis=SimpleNamespace(model_dump=lambda **_: {}))
    there = tmp_path / "there"
    there.write_bytes(b"mine")
    wanted = {"json": None, "report": None, "rig": None} | {option: there}
    with pytest.raises(WorkError, match="exists already"):
        save(result, **wanted, overwrite=False)
    assert there.read_bytes() == b"mine"
    save(result, **wanted, overwrite=True)
    assert there.read_bytes() != b"mine" and list(tmp_path.iterdir()) == [there]


def test_a_file_that_comes_while_another_is_written_in_its_place_stays(tmp_path):
    from station.runs.files import new_file

    there = tmp_path / "there"
    with pytest.raises(WorkError, match="has come there meanwhile"), new_file(there) as part:
        part.write_text("made")
        there.write_text("mine")
    assert there.read_text() == "mine" and list(tmp_path.iterdir()) == [there]


def test_a_file_that_cannot_be_moved_into_place_leaves_nothing_there(tmp_path, monkeypatch):
    from station.runs.files import new_file

    def fails(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("station.runs.files.os.replace", fails)
    with pytest.raises(WorkError, match="Input/output error"), new_file(tmp_path / "there") as part:
        part.write_text("made")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "option", "source"), [
    (name, option, source) for name, options in WRITES.items() if name != "view" for option in options
    for source in ("log.csv", "my_rig.toml") if source == "log.csv" or name not in ("export", "trim", "recover")])
def test_an_input_is_never_an_output(station, arguments, tmp_path, name, option, source):
    path = tmp_path / source
    before = path.read_bytes()
    ended = station(name, *arguments[name], option, path.parent / "." / path.name, "--overwrite")
    assert ended.status == 2 and "is an input of this command" in ended.one_line()
    assert path.read_bytes() == before


def test_overwrite_replaces_what_is_there(station, step, tmp_path):
    out = tmp_path / "measures.json"
    out.write_text("old", encoding="utf-8")
    assert station("compare", "--rig", "sflr", step, "--json", out, "--overwrite").status == 0
    assert out.read_text(encoding="utf-8").startswith("{")


def test_two_outputs_of_one_name_are_refused(station, step, tmp_path):
    ended = station("diagnose", "--rig", "sflr", step, "--json", tmp_path / "x", "--report", tmp_path / "x")
    assert ended.status == 2 and "named for two outputs" in ended.one_line()
