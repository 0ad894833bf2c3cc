"""The examples of the help texts and of the README run as they stand."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from station.rig import builtin_rigs
from station.runs import export_run, load_run
from tests.cli.conftest import step_run
from tests.cli.test_help import COMMANDS, ROOT

SLOW = {"campaign", "demo", "device", "diagnose", "fit", "investigate"}
"""Run in tests of their own, on smaller cases (device: until Ctrl-C)."""
EXAMPLES = {name: command.epilog.removeprefix("Example: ") for name, command in COMMANDS.items()}


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """A folder with the files that examples name."""
    folder = tmp_path_factory.mktemp("bench")
    for name in ("step", "pulse", "sweep"):
        export_run(step_run(name=name, rows=5000), folder / f"{name}.mcap")
    shutil.copy(folder / "step.mcap", folder / "broken.mcap")
    export_run(load_run(folder / "step.mcap"), folder / "step.csv")
    (folder / "demo" / "runs").mkdir(parents=True)
    (folder / "my_rig.toml").write_text(builtin_rigs()["sflr"], encoding="utf-8")
    return folder


@pytest.fixture
def there(bench, tmp_path, monkeypatch) -> Path:
    """A copy of it, as the current folder."""
    folder = tmp_path / "there"
    shutil.copytree(bench, folder)
    monkeypatch.chdir(folder)
    return folder


def _free(arguments: list[str]) -> None:
    """Take away what the command is to write."""
    for option in ("--out", "--save"):
        if option in arguments:
            Path(arguments[arguments.index(option) + 1]).unlink(missing_ok=True)


@pytest.mark.parametrize("name", sorted(set(EXAMPLES) - SLOW))
def test_the_example_of(station, there, name):
    program, *arguments = shlex.split(EXAMPLES[name])
    assert program == "station" and arguments[: len(name.split())] == name.split()
    _free(arguments)
    ended = station(*arguments)
    assert ended.status == 0, ended.err


def _readme() -> list[str]:
    """The station commands of the README's blocks, one per line."""
    blocks = re.findall(r"```\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [" ".join(line.split()) for line in lines if line.strip().startswith("station ")]


def test_the_readme_has_commands():
    assert len(_readme()) >= 7


@pytest.mark.parametrize("line", [line for line in _readme() if " diagnose " not in line])
def test_the_readme_says(station, there, line):
    arguments = shlex.split(line.replace("/dev/ttyUSB0", "sim://sflr"))[1:]
    _free(arguments)
    ended = station(*arguments)
    assert ended.status == 0, ended.err


def test_the_readme_names_options_that_diagnose_has():
    (line,) = [line for line in _readme() if " diagnose " in line]
    known = {option for parameter in COMMANDS["diagnose"].params for option in parameter.opts}
    assert {word for word in shlex.split(line) if word.startswith("--")} <= known
