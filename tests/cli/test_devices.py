"""Ports, loopback, check and the simulated rig for other programs, from the command line."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from station.device.arm import GCC
from station.device.build import source_hash
from station.device.emulator import QEMU
from station.device.protocol import MESSAGES
from station.device.sealed import fingerprint, sealed_text
from station.rig import builtin_rigs
from station.runs import load_run

ROOT = Path(__file__).resolve().parents[2]


def test_ports_lists_the_simulated_rigs(station):
    assert "sim://sflr" in station("ports").out
    found = json.loads(station("ports", "--json", "-").out)
    assert "sim://sflr" in found["simulated"] and found["sealed"] == [f"sim://sealed-{n}" for n in (1, 2, 3)]
    assert "sim://sealed-1" in station("ports").out


def test_loopback_judges_a_good_line_and_a_bad_one(station):
    assert json.loads(station("loopback", "--port", "sim://sflr", "--json", "-").out)["ok"]
    bad = station("loopback", "--port", "sim://sflr?drop=0.05&seed=3")
    assert bad.status == 0 and "Not good" in bad.out


def test_check_passes_the_rig_it_knows_and_names_a_reversed_motor(station, tmp_path):
    good = station("check", "--port", "sim://sflr", "--rig", "sflr")
    assert good.status == 0 and good.out.startswith("Passed")
    turned = tmp_path / "turned.toml"
    turned.write_text(builtin_rigs()["sflr"].replace("gain = 0.0106887", "gain = -0.0106887"))
    found = json.loads(station("check", "--port", f"sim://x?rig={turned}", "--rig", "sflr", "--json", "-").out)
    assert not found["passed"] and found["motor"] == -1


def test_loopback_shows_every_counter_of_the_device(station):
    names = {field.name for field in MESSAGES["statistics"].fields}
    told = station("loopback", "--port", "sim://sflr?drop=0.05&seed=3").out
    assert names >= {"held", "zeroed", "late", "corrupt", "overruns", "woke_late", "unsent_samples"}
    line = next(line for line in told.splitlines() if line.startswith("the device's counters:"))
    assert all(f" {name} " in line for name in names - {"state", "fault", "status"})
    assert int(re.search(r" held (\d+)", line)[1]) > 0
    found = json.loads(station("loopback", "--port", "sim://sflr", "--json", "-").out)
    assert set(found["counters"]) == names


@pytest.mark.parametrize("command", [["loopback"], ["check", "--rig", "sflr"]])
def test_a_port_that_is_nowhere(station, command):
    ended = station(*command, "--port", "/dev/no-such-port")
    assert ended.status == 2 and "/dev/no-such-port" in ended.one_line()


def test_a_device_that_never_answers(station):
    ended = station("check", "--rig", "sflr", "--port", "loop://")
    assert ended.status == 1 and "loop://" in ended.one_line()


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise on Windows")
@pytest.mark.parametrize("board", ["host", "mps2_an385"])
def test_another_program_finds_the_device_at_a_socket(station, tmp_path, board):
    if board != "host" and not (shutil.which(QEMU) and shutil.which(GCC)):
        pytest.skip(f"no {QEMU} or no {GCC} here")
    arguments = ["device", "--rig", "sflr", "--tcp", "0", "--speed", "0", "--board", board]
    process = subprocess.Popen([sys.executable, "-m", "station", *arguments], cwd=ROOT, stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().strip()
        assert address.startswith("socket://127.0.0.1:")
        out = tmp_path / "run.mcap"
        ended = station("run", "step", "--port", address, "--rig", "sflr", "--duration", "0.6", "--out", out)
        assert ended.status == 0, ended.err
        run = load_run(out)
        assert len(run) == 300 and run.metadata.firmware["board"] == "sflr"
        assert (run.metadata.firmware["build"] == f"{source_hash():08x}") == (board == "host")
    finally:
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 0 and "Traceback" not in err


@pytest.mark.long
def test_a_sealed_rig_is_tested_diagnosed_and_opened(station, tmp_path):
    """As the README says it: nothing of what is hidden stands in the runs; the seal's words judge the diagnosis."""
    files = []
    for kind, more in (("pulse", []), ("step", ["--controller", "lead"]), ("sweep", ["--duration", 8, "--f1", 20])):
        files.append(tmp_path / f"{kind}.mcap")
        ended = station("run", kind, "--port", "sim://sealed-1", "--rig", "sflr", "--out", files[-1], *more)
        assert ended.status == 0, ended.err
        assert not load_run(files[-1]).metadata.rig["effects"]
    found = tmp_path / "diagnosis.json"
    assert station("diagnose", "--rig", "sflr", *files, "--effort", "quick", "--json", found).status == 0
    ended = station("unseal", "sealed-1", "--diagnosis", found, "--out", tmp_path / "hidden.toml")
    assert ended.status == 0 and ended.out.startswith("Hidden was: ") and "\nRIGHT: " in ended.out
    assert (tmp_path / "hidden.toml").read_text() == sealed_text("sealed-1")
    assert fingerprint("sealed-1") in ended.out
    causes = json.loads(found.read_text())
    found.write_text(json.dumps(causes | {"causes": []}))
    assert "WRONG: nothing was named" in station("unseal", "sim://sealed-1", "--diagnosis", found).out


@pytest.mark.parametrize(("options", "status", "words"), [
    (["sealed-9"], 2, "there are sealed-1"), (["sealed-1", "--diagnosis", "nowhere.json"], 1, "nowhere.json"),
    (["sealed-1", "--diagnosis", __file__], 2, "not a diagnosis"),
    (["sealed-1", "--diagnosis", __file__, "--out", __file__], 2, "is an input")])
def test_a_seal_that_is_opened_wrongly(station, options, status, words):
    ended = station("unseal", *options)
    assert ended.status == status and words in ended.one_line()
