"""Ports, loopback, check and the simulated rig for other programs, from the command line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from station.rig import builtin_rigs
from station.runs import load_run

ROOT = Path(__file__).resolve().parents[2]


def test_ports_lists_the_simulated_rigs(station):
    assert "sim://sflr" in station("ports").out
    assert "sim://sflr" in json.loads(station("ports", "--json", "-").out)["simulated"]


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


@pytest.mark.parametrize("command", [["loopback"], ["check", "--rig", "sflr"]])
def test_a_port_that_is_nowhere(station, command):
    ended = station(*command, "--port", "/dev/no-such-port")
    assert ended.status == 2 and "/dev/no-such-port" in ended.one_line()


def test_a_device_that_never_answers(station):
    ended = station("check", "--rig", "sflr", "--port", "loop://")
    assert ended.status == 1 and "loop://" in ended.one_line()


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise on Windows")
def test_another_program_finds_the_device_at_a_socket(station, tmp_path):
    process = subprocess.Popen([sys.executable, "-m", "station", "device", "--rig", "sflr", "--tcp", "0",
                                "--speed", "0"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().strip()
        assert address.startswith("socket://127.0.0.1:")
        out = tmp_path / "run.mcap"
        ended = station("run", "step", "--port", address, "--rig", "sflr", "--duration", "0.6", "--out", out)
        assert ended.status == 0, ended.err
        assert len(load_run(out)) == 300
    finally:
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 0 and "Traceback" not in err
