"""Every command explains itself, with an example, and quickly."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

from station.cli import THREADS
from station.cli.app import build

ROOT = Path(__file__).resolve().parents[2]


def _commands() -> dict[str, typer.core.TyperCommand]:
    found = {}

    def walk(group: typer.core.TyperGroup, path: list[str]) -> None:
        for name, command in group.commands.items():
            found[" ".join([*path, name])] = command
            if isinstance(command, typer.core.TyperGroup):
                walk(command, [*path, name])

    walk(typer.main.get_command(build()), [])
    return found


COMMANDS = _commands()


@pytest.mark.parametrize("name", COMMANDS)
def test_help_says_what_it_does_and_shows_an_example(station, name):
    ended = station(*name.split(), "--help")
    assert ended.status == 0 and ended.err == ""
    text = " ".join(ended.out.split())
    assert f"Usage: station {name}" in text
    assert "Example: station " in text
    assert COMMANDS[name].help


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained(name):
    for parameter in COMMANDS[name].params:
        assert getattr(parameter, "help", None), f"{name}: {parameter.name}"


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_no_word_of_a_help_is_taken_for_a_mark(name):
    """What stands in square brackets is taken by the help's own markup, and is not shown."""
    command = COMMANDS[name] if name else typer.main.get_command(build())
    for text in (command.help, command.epilog, *(getattr(parameter, "help", None) for parameter in command.params),
                 *(parameter.metavar for parameter in command.params)):
        assert Text.from_markup(text or "").plain == (text or "")


@pytest.mark.parametrize(("typed", "offered"), [
    ("station vi", {"view"}), ("station run s", {"step", "sweep"}),
    ("station view --", {"--rig", "--extended", "--save", "--web", "--overwrite", "--help"}),
    ("station diagnose --effort ", {"quick", "full"})])
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_is_offered_commands_options_and_choices(monkeypatch, shell, typed, offered):
    words = typed.split(" ")
    monkeypatch.setenv("_TYPER_COMPLETE_TESTING", "1")          # else Typer asks which shell runs it
    ended = CliRunner().invoke(build(), [], prog_name="station", env={
        "_STATION_COMPLETE": f"complete_{shell}", "COMP_WORDS": typed, "COMP_CWORD": str(len(words) - 1),
        "_TYPER_COMPLETE_ARGS": typed, "_TYPER_COMPLETE_FISH_ACTION": "get-args"})
    assert ended.exit_code == 0
    found = set(re.findall(r"^\"?([\w-]+)" if shell != "zsh" else r'"([\w-]+)"', ended.stdout, flags=re.MULTILINE))
    assert offered <= found


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_completes_its_options(monkeypatch, name):
    typed = f"station {name} --"
    ended = CliRunner().invoke(build(), [], prog_name="station", env={
        "_STATION_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split(" ")) - 1)})
    offered = set(ended.stdout.split())
    wanted = {option for parameter in COMMANDS[name].params for option in parameter.opts if option.startswith("--")}
    assert wanted and wanted <= offered


def test_without_a_command_the_help_is_shown(station):
    ended = station()
    assert ended.status == 0 and "demo" in ended.out


def test_help_imports_nothing_heavy():
    """What would make `station --help` slow is not imported for it."""
    script = ("import sys\nfrom station.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
              "heavy = {'numpy', 'scipy', 'numba', 'control', 'plotly', 'rerun', 'pyarrow', 'serial', 'pydantic'}\n"
              "print('heavy:', sorted(heavy & set(sys.modules)))")
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "heavy: []"


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("2", "2")])
def test_numpy_is_given_one_thread_unless_the_user_says_otherwise(given, used):
    """NumPy reads these once, when it is imported: they stand before that."""
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    environment |= {} if given is None else dict.fromkeys(THREADS, given)
    script = (f"import os, sys\nfrom station.cli import main\nassert 'numpy' not in sys.modules\n"
              f"try:\n    main(['--version'])\nexcept SystemExit:\n    pass\n"
              f"print([os.environ[name] for name in {THREADS}], 'numpy' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True,
                          check=True)
    assert done.stdout.splitlines()[-1] == f"{[used, used]} False"
