"""Every example of README, docs and firmware pages runs, and those of the help texts that others leave out.

tests/cli/test_examples.py runs the help texts' quick examples, tests/docs/test_tutorial.py the tutorial in its order,
tests/model/test_own_effects.py holds docs/own_effect.md against scripts/own_effect.py, tests/test_api.py runs
docs/python.md.  A board is played by the simulated rig, and a diagnosis takes the quick effort (so does each of an
investigation); else lines run as they stand.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from station.campaign.plan import load_tasks
from station.rig import Rig, builtin_rigs
from station.runs import export_run
from tests.cli.conftest import step_run
from tests.cli.test_examples import EXAMPLES, SLOW
from tests.cli.test_help import COMMANDS
from tests.docs.pages import PAGES, ROOT, TUTORIAL, blocks, inline, lines

ELSEWHERE = {"python scripts/demo": "tests/cli/test_diagnosis.py runs the demo by the quick effort",
             "python scripts/test": "runs these tests",
             "python scripts/own_effect.py": "tests/model/test_own_effects.py",
             "apt install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm": "needs the network",
             "station campaign plan.toml --out campaign --scheduler tls://head:8786 --tls-ca ca.pem --tls-cert me.pem "
             "--tls-key me.key": "needs a cluster with certificates; tests/campaign/test_run.py has one of two workers"}
"""Lines that are not run here, and why."""
QUICK = {"diagnose", "investigate"}
UNTIL_CTRL_C = {"device"}
LONG = {*(f"station diagnose --rig {rig}.toml pulse.mcap step.mcap sweep.mcap --report report.html"
          for rig in ("fitted", "my_rig")), "station campaign plan.toml --out campaign"}
"""Do once more what other lines do, or tests/cli."""
EVERY = sorted({(line, page.name) for page in PAGES if page != TUTORIAL for line in lines(page)})
STATION = sorted({line.replace("/dev/ttyUSB0", "sim://sflr") for line, _ in EVERY if line.startswith("station ")}
                 | {EXAMPLES[name] for name in SLOW - {"demo"}})
SHOWN = [line for line in STATION if line.split()[1] == "view" and "--save" not in line]
"""Open a viewer that stays: tests/view has them; here their options are looked at."""
RUN = [line for line in STATION if line not in ELSEWHERE and line not in SHOWN and line.split()[1] not in UNTIL_CTRL_C
       and (line.split()[1] != "investigate" or "my_rig" in line)]      # a minute each; they differ in the rig's name
needs_qemu = pytest.mark.skipif(shutil.which("qemu-system-arm") is None or shutil.which("arm-none-eabi-gcc") is None,
                                reason="no qemu-system-arm or no arm-none-eabi-gcc here")


def test_the_pages_have_examples():
    assert len(RUN) >= 20 and len({page for _, page in EVERY}) >= 9


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """A folder with the files that examples name."""
    folder = tmp_path_factory.mktemp("bench")
    for name in ("step", "pulse", "sweep", "reference"):
        export_run(step_run(name=name, rows=600), folder / f"{name}.mcap")
    for name in ("my_rig.toml", "fitted.toml", "better_rig.toml"):
        (folder / name).write_text(builtin_rigs()["sflr"], encoding="utf-8")
    (folder / "servo.toml").write_text(blocks(ROOT / "docs" / "other_rig.md", "toml")[0], encoding="utf-8")
    export_run(step_run(str(folder / "servo.toml"), amplitude=100.0), folder / "servo.mcap")
    (folder / "day.toml").write_text(blocks(ROOT / "docs" / "plans.md", "toml")[0], encoding="utf-8")
    (folder / "plan.toml").write_text('effort = "quick"\n[[logs]]\nname = "bench"\nrig = "my_rig.toml"\n'
                                      'runs = ["step.mcap", "pulse.mcap"]\n', encoding="utf-8")
    return folder


@pytest.fixture
def there(bench, tmp_path, monkeypatch) -> Path:
    """A copy of it, as the current folder."""
    folder = tmp_path / "there"
    shutil.copytree(bench, folder)
    monkeypatch.chdir(folder)
    return folder


def marks(line: str) -> list[pytest.MarkDecorator]:
    """Of a line; an investigation is tests and diagnoses that others make, three times."""
    again = line.split()[1] == "investigate" or line in LONG
    return [needs_qemu] * ("qemu://" in line) + [pytest.mark.long] * again


@pytest.mark.parametrize("line", [pytest.param(line, marks=marks(line)) for line in RUN])
def test_the_line(station, there, line):
    arguments = shlex.split(line)[1:]
    made = [arguments[i + 1] for i, word in enumerate(arguments)
            if word in ("--out", "--save", "--save-rig", "--json", "--report")]
    for name in made:
        Path(name).unlink(missing_ok=True)
    if arguments[0] in QUICK and "--effort" not in arguments:
        arguments += ["--effort", "quick"]
    ended = station(*arguments)
    assert ended.status == 0, ended.err
    assert [name for name in made if not Path(name).exists()] == []


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise on Windows")
@pytest.mark.parametrize("line", [pytest.param(line, marks=needs_qemu if "--board" in line else ())
                                  for line in STATION if line.split()[1] in UNTIL_CTRL_C])
def test_the_device_of_the_line_is_there_until_ctrl_c(there, line):
    with socket.socket() as free:       # the port of the example may be somebody else's on this machine
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    arguments = shlex.split(line)[1:]
    arguments[arguments.index("--tcp") + 1] = port
    process = subprocess.Popen([sys.executable, "-m", "station", *arguments], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert process.stdout.readline().strip() == f"socket://127.0.0.1:{port}"
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0, process.stderr.read()
    finally:
        process.kill()
        process.communicate()


def test_what_is_not_run_here_stands_in_a_page():
    assert set(ELSEWHERE) <= {line for line, _ in EVERY}


@pytest.mark.parametrize("line", sorted({line for line, _ in EVERY if line.startswith("python ")}))
def test_a_script_that_a_page_calls_is_there_with_the_options_it_names(line):
    _, name, *options = shlex.split(line)
    text = (ROOT / name).read_text(encoding="utf-8")
    assert [option for option in options if option.startswith("--") and f'"{option}"' not in text] == []


def _options(command: typer.core.TyperCommand) -> set[str]:
    return {option for parameter in command.params for option in parameter.opts} | {"--help"}


@pytest.mark.parametrize(("line", "page"), sorted({(line, page.name) for page in PAGES for line in inline(page)}
                                            | {(line, "") for line in SHOWN}))
def test_a_command_in_a_sentence_exists_with_its_options(line, page):
    words = line.split()[1:]
    if words[0].startswith("--"):       # of station itself
        assert words[0] in {"--help", "--effects", "--install-completion"}
        return
    name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
    known = _options(COMMANDS[name])
    if name == "run":                   # KIND, or the options that kinds share
        known |= _options(COMMANDS["run step"])
    assert [word for word in words if word.startswith("--") and word not in known] == []


@pytest.mark.parametrize(("page", "count"), [("calibrate.md", 1), ("other_rig.md", 3)])
def test_a_rig_file_of_a_page_is_one(page, count):
    found = blocks(ROOT / "docs" / page, "toml")
    assert len(found) == count
    assert all(Rig.from_toml(text).name for text in found)


def test_the_limits_of_the_page_on_a_day_of_tests_belong_into_a_rig_file():
    (text,) = blocks(ROOT / "docs" / "lab.md", "toml")
    rig = Rig.from_toml(builtin_rigs()["sflr"] + text)
    assert (rig.limits.travel, rig.limits.speed, rig.command_limit) == (3.0, 40.0, 120.0)


def test_the_plan_of_the_example_is_one(there):
    assert [task.group for task in load_tasks(there / "plan.toml")] == ["logs"]


def test_every_toml_block_is_read_by_a_test():
    """Rigs and limits above, docs/plans.md by its command, docs/campaign.md by tests/campaign/test_plan.py."""
    found = {page.name: len(blocks(page, "toml")) for page in PAGES if blocks(page, "toml")}
    assert found == {"calibrate.md": 1, "campaign.md": 1, "lab.md": 1, "other_rig.md": 3, "own_effect.md": 1,
                     "plans.md": 1}
    (entry,) = blocks(ROOT / "docs" / "own_effect.md", "toml")
    assert tomllib.loads(entry)["project"]["entry-points"]["station.effects"]


def test_every_python_block_is_run_by_a_test():
    """docs/tutorial.md by test_tutorial.py, docs/python.md by tests/test_api.py, docs/own_effect.md as stated above."""
    found = {page.name: len(blocks(page, "python")) for page in PAGES if blocks(page, "python")}
    assert found == {"own_effect.md": 4, "python.md": 1, "tutorial.md": 1}


def test_no_block_stands_outside_these_checks():
    """A block is TOML, Python, or holds commands (and what they print)."""
    for page in PAGES:
        languages = set(re.findall(r"^ *```(\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE))
        assert languages <= {"toml", "python"}, page.name
        assert all(re.match(r"(station|python|apt) ", block.strip()) for block in blocks(page)), page.name
