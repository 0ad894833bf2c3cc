"""Real-time mode says what it got and what it could not get, and leaves the process as it was."""

import contextlib
import errno
import gc
import os
import sys
from pathlib import Path

import pytest

from station.errors import WorkError
from station.loop import realtime
from station.loop.realtime import undisturbed_thread

pytestmark = pytest.mark.fresh     # to lock all memory of a process that has grown to gigabytes takes a minute
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the means of Linux")


def state():
    return os.sched_getscheduler(0), os.sched_getaffinity(0), gc.isenabled(), gc.get_freeze_count()


@LINUX
def test_what_is_said_to_be_granted_is_so_and_is_put_back():
    before = state()
    with undisturbed_thread(True) as found:
        scheduler, cores, collecting, frozen = state()
        assert ("SCHED_FIFO" in found.got) == (scheduler == os.SCHED_FIFO)
        assert ("one core" in found.got) == (cores == {max(before[1])})
        assert "garbage collection frozen" in found.got and not collecting and frozen > 1000
        lines = Path("/proc/self/status").read_text().splitlines()
        locked = next(line for line in lines if line.startswith("VmLck"))
        assert ("memory locked" in found.got) == (int(locked.split()[1]) > 1000)
        assert len(found.got) + len(found.missing) == 6
    assert state() == before


@LINUX
def test_what_is_refused_is_told_with_the_systems_words(monkeypatch, tmp_path):
    def refused(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    monkeypatch.setattr(realtime, "_DMA_LATENCY", "/nonexistent/latency")
    monkeypatch.setattr(realtime, "_CPUINFO", str(tmp_path / "cpuinfo"))
    (tmp_path / "cpuinfo").write_text("processor : 0\nflags : fpu tsc\n")
    with undisturbed_thread(True) as found:
        assert "SCHED_FIFO (Operation not permitted)" in found.missing
        assert "cores kept awake (No such file or directory)" in found.missing
        assert "not granted: cores kept awake" in found.words()


@LINUX
@pytest.mark.parametrize(("flags", "terminal", "kept"), [
    ("fpu tsc sse2", False, True), ("fpu tsc hypervisor sse2", False, False), ("fpu tsc hypervisor sse2", True, True)])
def test_cores_are_kept_awake_but_for_a_socket_in_a_virtual_machine(flags, terminal, kept, monkeypatch, tmp_path):
    latency, told = tmp_path / "latency", tmp_path / "cpuinfo"
    told.write_text(f"processor : 0\nflags : {flags}\nbugs : none\n")
    latency.write_bytes(b"")
    monkeypatch.setattr(realtime, "_CPUINFO", str(told))
    monkeypatch.setattr(realtime, "_DMA_LATENCY", str(latency))
    with undisturbed_thread(True, terminal=terminal) as found:
        assert latency.read_bytes() == (bytes(4) if kept else b"")
        assert ("cores kept awake" in found.got) == kept
        assert any("cores would spin" in words for words in found.missing) != kept


def test_it_is_off_where_it_is_not_asked_for():
    before = gc.get_freeze_count()
    with undisturbed_thread(False) as found:
        assert found is None and gc.get_freeze_count() == before


@LINUX
def test_a_test_in_real_time_mode_logs_what_it_got(rows):
    before, seen = state(), []

    def sink(metadata):
        made = rows.sink(metadata)
        keep = made.rows.append
        made.append = lambda row: (keep(row), seen.append(os.sched_getscheduler(0)))
        return made

    with contextlib.suppress(WorkError):  # a busy machine may fault the device
        rows.test_at("sim://sflr?speed=1", rows=200, realtime=True, log_sink=sink)
    said = rows.sinks[-1].metadata.entries()["realtime"]
    assert ("SCHED_FIFO" in said["got"]) == (seen[0] == os.SCHED_FIFO)
    assert state() == before
