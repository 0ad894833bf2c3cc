"""The abort key, pressed on a terminal."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from station.cli.keys import abort_key
from station.runs import load_run

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(os.name == "nt", reason="the terminal of POSIX")


@pytest.mark.parametrize(("key", "stops"), [(b" ", True), (b"q", True), (b"\x1b", True), (b"x", False)])
def test_a_key_stops_a_test_and_keeps_its_rows(tmp_path, key, stops):
    import pty

    out = tmp_path / "run.mcap"
    keyboard, terminal = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "station", "run", "step", "--port", "sim://sflr?speed=1", "--rig", "sflr", "--duration",
         "20" if stops else "1.5", "--out", str(out)], cwd=ROOT, stdin=terminal, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=lambda: _take(terminal))
    os.close(terminal)
    try:
        end = time.monotonic() + 240.0  # on a fresh checkout the stepper is compiled first, beside other tests
        while not (out.exists() and out.stat().st_size > 9000) and time.monotonic() < end and process.poll() is None:
            time.sleep(0.05)
        os.write(keyboard, key)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
        os.close(keyboard)
    assert out.exists(), err
    run = load_run(out)
    if "in fault" in err or "fell silent" in err:
        pytest.skip("the machine is too busy for a paced loop")
    if stops:
        assert process.returncode == 130 and err.splitlines()[-1] == "station: interrupted"
        assert run.metadata.entries()["outcome"] == "interrupted" and 10 < len(run) < 10_000
    else:
        assert process.returncode == 0, err
        assert len(run) == 750


def test_a_key_pressed_while_the_command_starts_stops_the_test(tmp_path):
    """While the command starts nobody reads the terminal yet; the key waits there."""
    import pty

    out = tmp_path / "run.mcap"
    keyboard, terminal = pty.openpty()
    os.write(keyboard, b"q")
    process = subprocess.Popen(
        [sys.executable, "-m", "station", "run", "step", "--port", "sim://sflr", "--rig", "sflr", "--duration", "20",
         "--out", str(out)], cwd=ROOT, stdin=terminal, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=lambda: _take(terminal))
    os.close(terminal)
    try:
        _, err = process.communicate(timeout=240)
    finally:
        process.kill()
        process.wait()
        os.close(keyboard)
    assert process.returncode == 130 and err.splitlines()[-1] == "station: interrupted"
    assert not out.exists() or len(load_run(out)) < 1000  # in virtual time a busy machine may come to a few rows


def _take(terminal: int) -> None:
    """Make the terminal the child's own, as a shell does."""
    import fcntl
    import termios

    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)


def test_where_no_terminal_is_no_key_is_heard(monkeypatch):
    read, write = os.pipe()
    with os.fdopen(read) as stdin, os.fdopen(write, "w"):
        monkeypatch.setattr(sys, "stdin", stdin)
        before = threading.active_count()
        with abort_key(lambda: pytest.fail("pressed")) as heard:
            assert not heard and threading.active_count() == before
