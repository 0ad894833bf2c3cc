"""Ctrl-C ends a command in one line, whenever it comes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from station.cli import _Interruption

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise on Windows")

READY = """
import sys
print("in", flush=True)
from station.cli import main
main(sys.argv[1:])
"""


@pytest.mark.parametrize("wait", [0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.9, 1.3])
def test_ctrl_c_at_any_moment_of_the_start_prints_one_line(wait, tmp_path):
    """From the program's first line on: while it imports, reads the rig, opens the port, compiles, tests."""
    out = tmp_path / "run.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", READY, "run", "sweep", "--port", "sim://sflr?speed=1", "--rig", "sflr", "--force",
         "--out", str(out)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "in\n"
    time.sleep(wait)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert "Traceback" not in err and "Error" not in err
    assert err.splitlines()[-1] == "station: interrupted"


def test_an_interrupt_that_a_callback_swallows_is_raised_again():
    interruption = _Interruption()
    try:
        class Swallows:
            def __del__(self) -> None:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            Swallows()
            time.sleep(1.0)
    finally:
        interruption.end()
    assert interruption.came
