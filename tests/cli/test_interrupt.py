"""Ctrl-C ends a command in one line, whenever it comes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from station.cli import _Interruption, raise_interrupt

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise on Windows")

READY = """
import station.cli
run = station.cli._status
station.cli._status = lambda *given: (print("in", flush=True), run(*given))[1]
station.cli.main()
"""
"""What is before (Python's own start, a few milliseconds of imports) shows Python's traceback as ever."""


@pytest.mark.parametrize("wait", [0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.9, 1.3])
def test_ctrl_c_at_any_moment_of_the_start_prints_one_line(wait, tmp_path):
    """From the first line of ``main`` on: while it imports, reads the rig, opens the port, compiles, tests."""
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


@pytest.mark.parametrize("busy", [0.0, 0.05])
def test_an_interrupt_that_a_callback_swallows_is_raised_again(busy, monkeypatch):
    """However long a busy machine takes to start the thread that raises it: in the hook it would be swallowed again."""
    plain = threading.Thread.start
    monkeypatch.setattr(threading.Thread, "start", lambda self: (plain(self), time.sleep(busy)))
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


@pytest.mark.parametrize("came", [False, True])
def test_what_an_interrupt_left_half_made_says_nothing_when_it_is_thrown_away(came, monkeypatch):
    """LLVM's values say what their half-made selves lack; without an interrupt that is a fault, and is told."""
    told = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    interruption = _Interruption()

    class HalfMade:
        def __del__(self) -> None:
            raise AttributeError("half made")

    try:
        interruption.came = came
        HalfMade()
    finally:
        interruption.end()
    assert len(told) == (not came)


def test_an_interrupt_that_an_import_swallowed_is_heard_before_a_motor_is_armed(tmp_path):
    from station.cli.run import perform
    from station.device.client import Client
    from station.device.port import open_port
    from station.loop.sink import MemorySink
    from station.rig import load_rig

    interruption = _Interruption()
    try:
        with pytest.raises(KeyboardInterrupt):
            interruption._handle(signal.SIGINT, None)  # and whoever called it went on
        with open_port("sim://sflr") as line, pytest.MonkeyPatch.context() as patch:
            patch.setattr(Client, "arm", lambda self: pytest.fail("armed"))
            with pytest.raises(KeyboardInterrupt):
                perform(line, load_rig("sflr"), {"kind": "open"}, {"kind": "pulse"}, MemorySink)
    finally:
        interruption.end()
    raise_interrupt()


def test_an_interrupt_whose_stop_was_not_confirmed_says_who_stops_the_motor(tmp_path, capsys, monkeypatch):
    from station.cli import main
    from station.device.client import Client
    from station.loop.engine import UNCONFIRMED, Session

    loop = Session._loop

    def interrupted(self):
        if self._rows > 200:
            raise KeyboardInterrupt
        loop(self)

    def test(out):
        with pytest.raises(SystemExit) as end:
            main(["run", "step", "--port", "sim://sflr", "--rig", "sflr", "--out", str(tmp_path / out)])
        assert end.value.code == 130
        return capsys.readouterr().err.splitlines()

    monkeypatch.setattr(Session, "_loop", interrupted)
    assert "watchdog" not in " ".join(test("one.mcap"))
    monkeypatch.setattr(Client, "halt", lambda self, next_index=None: False)
    assert test("two.mcap")[-2:] == [f"station: {UNCONFIRMED}", "station: interrupted"]
