"""The tutorial, every command in its order, and what it promises."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys

import pytest

from station.rig import load_rig
from tests.docs.pages import ROOT, TUTORIAL


def test_the_tutorial_runs_from_its_first_command_to_its_last(station, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = {}
    found = re.findall(r"^```(\w*)\n(.*?)^```$", TUTORIAL.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    for language, text in found:
        if language == "python":
            exec(compile(text, "tutorial.md", "exec"), {})
            continue
        for line in text.splitlines():
            if line.startswith("python "):      # installs, and shows the help: here that of the program itself
                assert line == "python scripts/demo --help" and (ROOT / "scripts" / "demo").is_file()
                subprocess.run([sys.executable, "-m", "station", "demo", "--help"], cwd=ROOT, check=True,
                               capture_output=True)
                continue
            ended = station(*shlex.split(line)[1:])
            assert ended.status == 0, f"{line}: {ended.err}"
            if line == "station compare --rig sflr first.mcap":
                assert re.search(r"^ first +0 % +0 % ", ended.out, re.MULTILINE)
            said[line.split(" --")[0] + ("" if "better.toml" not in line else " better")] = ended.out
    assert said["station loopback"].startswith("Good")

    found = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    (cause,) = found["causes"]
    torque = cause["parameters"]["torque"]
    assert (cause["effect"], cause["at"]) == ("coulomb_friction", "motor")
    assert found["verdict"] == "explained", "nothing else is hidden, and the simulated sensors only round"
    assert torque["low"] <= 0.03 <= torque["high"]
    (effect,) = load_rig(tmp_path / "better.toml").effects
    assert effect.torque == pytest.approx(torque["value"], rel=1e-3)
    for name in ("report.html", "step.rrd", "first.mcap"):
        assert (tmp_path / name).stat().st_size > 1000
    before = re.search(r"^ step +([\d.]+) %", said["station compare"], re.MULTILINE)
    after = re.search(r"^ step +([\d.]+) %", said["station compare better"], re.MULTILINE)
    assert float(before[1]) > 8.0 and float(after[1]) < 0.2 * float(before[1])
