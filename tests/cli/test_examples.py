"""The examples of the help texts run as they stand."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from station.rig import builtin_rigs
from station.runs import export_run, load_run
from tests.cli.conftest import step_run
from tests.cli.test_help import COMMANDS

SLOW = {"campaign", "demo", "device", "diagnose", "fit", "investigate"}
"""Run beside those of the pages, in tests/docs/test_examples.py; demo in test_diagnosis.py, by the quick effort."""
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
