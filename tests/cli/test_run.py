"""Tests on the simulated rig from the command line."""

from __future__ import annotations

import inspect
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from station.cli.run import KINDS, SWEEP_SPACING, WORDS
from station.control import references
from station.control.named import NAMED
from station.runs import load_run

ROOT = Path(__file__).resolve().parents[2]


def test_each_kind_of_test_is_a_command_with_its_own_defaults():
    assert set(KINDS) == set(references.KINDS)
    for kind, (_, defaults) in KINDS.items():
        assert defaults == references.defaults(kind), kind
        types = {name: type(value) for name, value in references.defaults(kind).items()}
        assert {name: type(value) for name, value in defaults.items()} == types, kind
        assert all(name in WORDS for name in defaults) and SWEEP_SPACING
    assert "rate" not in WORDS and inspect.isfunction(references.step)


@pytest.mark.parametrize("tag", ["", "a,b", "x" * 41])
def test_a_tag_that_no_note_takes_is_refused_before_the_test(station, tmp_path, tag):
    ended = station("run", "step", "--port", "sim://sflr", "--rig", "sflr", "--out", tmp_path / "run.mcap",
                    "--tag", "good", "--tag", tag)
    assert ended.status == 2 and f"--tag {tag!r}: 1 to 40 letters" in ended.one_line()
    assert not list(tmp_path.iterdir())


def test_a_refused_test_leaves_the_log_that_it_was_to_replace(station, tmp_path, monkeypatch):
    from station.errors import WorkError
    from station.loop.engine import Setup

    out, arm, armed = tmp_path / "run.mcap", Setup.arm, []
    asked = ["run", "step", "--port", "sim://sflr", "--rig", "sflr", "--duration", "0.5", "--out", out, "--overwrite"]
    assert station(*asked).status == 0
    before = out.read_bytes()

    def refuses(self, client):
        armed.append(self)
        if len(armed) == 2:  # the first is that in which the rest is measured
            raise WorkError("the device refuses arm: its e-stop is open")
        arm(self, client)

    monkeypatch.setattr(Setup, "arm", refuses)
    ended = station(*asked)
    assert ended.status == 1 and "its e-stop is open" in ended.one_line()
    assert out.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "run.rbl"}


@pytest.mark.parametrize(("kind", "options"), [
    ("step", ["--controller", "lead"]), ("step", ["--controller", "lead-accel", "--amplitude", "200"]),
    ("pulse", ["--width", "0.05"]), ("sweep", ["--duration", "4", "--f1", "10", "--gain", "1"]),
    ("prbs", ["--duration", "1.5"])])
def test_a_test_runs_and_its_log_replays(station, tmp_path, kind, options):
    out = tmp_path / "run.mcap"
    ended = station("run", kind, "--port", "sim://sflr", "--rig", "sflr", "--out", out, *options)
    assert ended.status == 0, ended.err
    assert "nothing lost or late" in ended.out
    run = load_run(out)
    assert run.metadata.test["kind"] == kind and run.metadata.command_row == -1
    assert run.metadata.rig["name"] == "sflr"
    assert np.ptp(run.encoder) > 5
    assert "every command is the compensator's" in station("replay", out).out


def test_the_readme_names_every_compensator_of_the_command_line():
    said = next(line for line in (ROOT / "README.md").read_text().splitlines() if "`--controller` is" in line)
    assert all(f"`{name}`" in said for name in NAMED) and len(NAMED) == 4


@pytest.mark.parametrize(("speed", "virtual"), [(0, True), (1, False)])
def test_virtual_time_is_said_as_such_and_real_time_is_not(station, tmp_path, speed, virtual):
    port = f"sim://sflr?speed={speed}"
    out = tmp_path / "run.mcap"
    ended = station("run", "pulse", "--port", port, "--rig", "sflr", "--duration", 0.6, "--out", out)
    if "in fault" in ended.err:
        pytest.skip("the machine is too busy for a paced loop")
    assert ("(0.6 s of virtual time)" in ended.out) == virtual and ("(0.6 s)" in ended.out) != virtual
    assert load_run(out).metadata.entries()["clock"] == ("virtual" if virtual else "real")
    assert ("(virtual time)" in station("loopback", "--port", port, "--seconds", 0.2).out) == virtual


@pytest.mark.parametrize(("options", "status", "named"), [
    (["--port", "/dev/no-such-port"], 2, "/dev/no-such-port"),
    (["--port", "sim://nowhere"], 2, "nowhere"),
    (["--port", "sim://sflr?colour=3"], 2, "colour"),
    (["--port", "replay://nowhere.mcap"], 1, "nowhere.mcap"),
    (["--port", "socket://127.0.0.1:1"], 1, "127.0.0.1"),
    (["--port", "nonsense://x"], 2, "nonsense"),
    (["--port", "sim://sflr", "--controller", "magic"], 2, "magic"),
    (["--port", "sim://sflr", "--controller", "p", "--pole", "3"], 2, "pole"),
    (["--port", "sim://sflr", "--duration", "0.1"], 2, "duration"),
    (["--port", "sim://sflr", "--rest", "0"], 2, "rest"),
    (["--port", "sim://sflr", "--amplitude", "nan"], 2, "amplitude"),
])
def test_what_cannot_run_leaves_no_log(station, tmp_path, options, status, named):
    out = tmp_path / "run.mcap"
    ended = station("run", "step", "--rig", "sflr", "--out", out, *options)
    assert ended.status == status, ended.err
    assert named in ended.one_line()
    assert not out.exists()


def test_a_log_of_another_form_is_refused(station, tmp_path):
    ended = station("run", "step", "--port", "sim://sflr", "--rig", "sflr", "--out", tmp_path / "run.csv")
    assert ended.status == 2 and ".mcap" in ended.one_line()


def test_a_log_in_the_way_is_kept(station, tmp_path):
    out = tmp_path / "run.mcap"
    out.write_text("mine")
    ended = station("run", "step", "--port", "sim://sflr", "--rig", "sflr", "--out", out)
    assert ended.status == 1 and out.read_text() == "mine"


def test_a_pulled_cable_ends_in_one_line_and_keeps_the_rows(station, tmp_path):
    out = tmp_path / "run.mcap"
    ended = station("run", "step", "--port", "sim://sflr?unplug_after=500", "--rig", "sflr", "--out", out)
    assert ended.status == 1
    kept, failure = ended.err.splitlines()
    assert str(out) in kept and "sim://sflr" in failure and "Traceback" not in ended.err
    assert 300 < len(load_run(out)) < 520


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise on Windows")
def test_ctrl_c_ends_in_one_line_and_keeps_the_rows(tmp_path):
    out = tmp_path / "run.mcap"
    process = subprocess.Popen(
        [sys.executable, "-m", "station", "run", "sweep", "--port", "sim://sflr?speed=1", "--rig", "sflr",
         "--out", str(out)], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not (out.exists() and out.stat().st_size > 4000) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130, err
    assert err.splitlines()[-1] == "station: interrupted" and "Traceback" not in err
    assert len(load_run(out)) > 10


def test_a_recording_tells_what_the_device_said(station, tmp_path):
    out, recording = tmp_path / "run.mcap", tmp_path / "run.rrd"
    assert station("run", "step", "--port", "sim://sflr?drop=0.05&on=command&seed=3", "--rig", "sflr", "--out",
                   out).status == 0
    assert station("view", out, "--save", recording).status == 0
    reader = pytest.importorskip("rerun.chunk", reason="this Rerun reads back in another way").RrdReader(recording)
    events = [chunk.to_record_batch() for chunk in reader.stream() if str(chunk.entity_path).endswith("/events")]
    said = {text for batch in events for name, column in zip(batch.schema.names, batch.columns, strict=True)
            if "text" in name.lower() for cell in column.to_pylist() for text in cell}
    assert "device says: held" in said
    assert "device says: running" not in said and "device says: moving" not in said
