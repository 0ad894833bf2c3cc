"""The live log: nothing dropped, nothing blocked, readable whatever ends it."""

import errno
import os
import re
import subprocess
import sys
import textwrap
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.port import open_port
from station.device.protocol import State
from station.errors import WorkError
from station.loop.run_test import run_test
from station.loop.sink import MemorySink
from station.rig import load_rig
from station.runs import McapLogWriter, annotate, export_run, load_run, mcap_log
from station.runs.mcap_read import scan_mcap
from station.runs.notes import tags_of
from station.runs.run import RunMetadata
from tests.runs.examples import METADATA, assert_same, full_run

ROOT = Path(__file__).resolve().parents[2]


def row(index: int) -> tuple:
    return (index, index / 500.0, 100.0, -3.5, 7.0, 0.04, index / 500.0, 5.0 + index / 500.0, 1, 2.0, 1e-4, 1e-3)


def test_rows_appended_one_by_one_give_the_run_back(tmp_path):
    run = full_run(500)
    columns = run.columns()
    with McapLogWriter(tmp_path / "a.mcap", METADATA, columns=tuple(columns)) as log:
        for values in zip(*(values.tolist() for values in columns.values()), strict=True):
            log.append(values)
    again = load_run(tmp_path / "a.mcap")
    assert_same(run, again)
    assert (tmp_path / "a.rbl").stat().st_size > 1000


def test_metadata_known_only_at_the_end_replace_the_first(tmp_path):
    log = McapLogWriter(tmp_path / "a.mcap", METADATA, blueprint=False)
    for index in range(10):
        log.append(row(index))
    log.close(METADATA.model_copy(update={"accel_zero": 1.25}))
    log.close()
    assert load_run(tmp_path / "a.mcap").metadata.accel_zero == 1.25
    with pytest.raises(WorkError, match="the log is closed"):
        log.append(row(11))


def test_a_running_log_is_readable_while_it_is_written(tmp_path):
    with McapLogWriter(tmp_path / "a.mcap", METADATA, blueprint=False) as log:
        for index in range(100):
            log.append(row(index))
        _until(lambda: log.rows_written == 100)
        time.sleep(0.05)
        run = load_run(tmp_path / "a.mcap")
        assert len(run) == 100 and run.metadata.model_extra["cut_short"]


def _until(done, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_full_queue_waits_and_drops_nothing(tmp_path):
    with McapLogWriter(tmp_path / "a.mcap", METADATA, capacity=50, blueprint=False) as log:
        for index in range(5000):
            log.append(row(index))
    assert log.waits > 10
    np.testing.assert_array_equal(load_run(tmp_path / "a.mcap").n, np.arange(5000))


def test_an_existing_log_is_never_replaced_unasked(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"kept")
    with pytest.raises(WorkError, match="exists already"):
        McapLogWriter(tmp_path / "a.mcap", METADATA)
    assert (tmp_path / "a.mcap").read_bytes() == b"kept"
    with McapLogWriter(tmp_path / "a.mcap", METADATA, overwrite=True, blueprint=False) as log:
        log.append(row(0))
        log.append(row(1))
    assert len(load_run(tmp_path / "a.mcap")) == 2


@pytest.mark.parametrize(("path", "words"), [("none/a.mcap", "does not exist"), (".", "is a folder")])
def test_a_place_that_cannot_be_written_is_refused_at_once(path, words, tmp_path):
    with pytest.raises(WorkError, match=words):
        McapLogWriter(tmp_path / path, METADATA)


class Quota:
    """A raw file on a disk that has so many bytes left; what fits of a write is written, as the system does."""

    def __init__(self, file, room):
        self._file, self.room = file, room

    def write(self, data):
        if self.room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self._file.write(data[:self.room])
        self.room -= written
        return written

    def __getattr__(self, name):
        return getattr(self._file, name)


@pytest.mark.parametrize("room", [1, 700, 1500, 3000, 5000, 8001])
def test_on_a_full_disk_the_rows_said_to_be_in_the_file_are_those_that_can_be_read(tmp_path, room):
    log = McapLogWriter(tmp_path / "a.mcap", METADATA, blueprint=False)
    for index in range(100):
        log.append(row(index))
    _until(lambda: log.rows_written == 100)
    log._file._file = Quota(log._file._file, room)
    appended = 100
    with pytest.raises(WorkError, match="a.mcap: the log cannot be written .No space left on device.*are lost"):
        for index in range(100, 100000):
            log.append(row(index))
            appended += 1
            time.sleep(0.0005)
    with pytest.raises(WorkError, match="No space left") as told:
        log.close()
    said, lost = (int(number) for number in re.search(r"(\d+) rows are in the file, (\d+) are lost", str(told.value))
                  .groups())
    run = load_run(tmp_path / "a.mcap")
    np.testing.assert_array_equal(run.n, np.arange(said))
    assert said == log.rows_written and said + lost == appended + 1  # the row whose append raised is lost, too
    assert run.metadata.model_extra["cut_short"]


def test_a_disk_that_does_not_keep_up_ends_a_test_in_real_time_and_drops_nothing(tmp_path):
    paced = RunMetadata(clock="real")
    log = McapLogWriter(tmp_path / "a.mcap", paced, capacity=200, blueprint=False)
    slow, commit = threading.Event(), log._file.commit
    log._file.commit = lambda: (slow.wait(30.0), commit())
    longest, taken = 0.0, 0
    with pytest.raises(WorkError, match=r"the disk does not keep up, 200 rows wait for it"):
        for index in range(10000):
            begun = time.perf_counter()
            log.append(row(index))
            longest, taken = max(longest, time.perf_counter() - begun), index + 1
            time.sleep(0.0001)
    assert longest < 0.1 and log.waits == 0  # it never waited for the disk
    slow.set()
    log.close()
    np.testing.assert_array_equal(load_run(tmp_path / "a.mcap").n, np.arange(taken + 1))


def test_a_log_without_rows_leaves_no_file(tmp_path):
    McapLogWriter(tmp_path / "a.mcap", METADATA).close()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_read_only_is_told_at_once(tmp_path, monkeypatch):
    if hasattr(os, "geteuid") and os.geteuid() == 0:  # root may write anywhere: the system's answer is put in
        def refused(*_, **__):
            raise PermissionError(errno.EACCES, "Permission denied")

        monkeypatch.setattr(Path, "open", refused)
    else:
        tmp_path.chmod(0o500)
    with pytest.raises(WorkError, match=r"a.mcap: cannot be written \(Permission denied\)"):
        McapLogWriter(tmp_path / "a.mcap", METADATA)


def test_a_test_on_a_full_disk_ends_with_the_motor_at_zero(tmp_path):
    """The rows that were counted as logged, lost, and sent after the stop are those that the device sent."""
    sinks = []

    def sink(metadata):
        sinks.append(McapLogWriter(tmp_path / "a.mcap", metadata, blueprint=False))
        sinks[-1]._file._file = Quota(sinks[-1]._file._file, 300_000)
        return sinks[-1]

    rig = load_rig("sflr")
    compensator = Compensator.from_spec({"kind": "p", "gain": 2.0}, rig.sample_rate, 200.0)
    reference = np.where(np.arange(60_000) < 100, 0.0, 60.0)
    with open_port("sim://sflr") as port:
        with pytest.raises(WorkError, match="No space left on device"):
            run_test(port, rig, compensator, reference, log_sink=sink)
        core = port.serial.device.core
        assert core.state == State.IDLE and core.drive == 0
        again = run_test(port, rig, compensator, reference[:300], log_sink=MemorySink)
        assert again.counts.samples == 300
    assert len(load_run(tmp_path / "a.mcap")) == sinks[0].rows_written > 0


def test_a_row_of_the_wrong_length_is_told(tmp_path):
    log = McapLogWriter(tmp_path / "a.mcap", METADATA, blueprint=False)
    log.append((1, 2.0))
    with pytest.raises(WorkError, match="the log cannot be written"):
        log.close()


def test_an_error_inside_the_block_is_not_hidden_and_the_log_is_closed(tmp_path):
    with pytest.raises(KeyError), McapLogWriter(tmp_path / "a.mcap", METADATA, blueprint=False) as log:
        log.append(row(0))
        log.append(row(1))
        raise KeyError("mine")
    assert scan_mcap(tmp_path / "a.mcap").cut_short is None


WRITER = textwrap.dedent("""
    import sys, time
    from station.runs.mcap_log import McapLogWriter
    from station.runs.run import RunMetadata
    log = McapLogWriter(sys.argv[1], RunMetadata(zero_id="bench"), blueprint=False)
    start = time.perf_counter()
    index = 0
    while True:
        log.append((index, index / 1000, 1.0, 2.0, 3.0, 4.0, 0.0, time.time(), 0, 0.0, 0.0, 0.0))
        index += 1
        if index % 10 == 0:
            print(index, flush=True)
        time.sleep(max(start + index / 1000 - time.perf_counter(), 0.0))
""")


@pytest.mark.parametrize("seconds", [0.21, 0.37, 0.83])
def test_a_killed_writer_loses_no_more_than_the_last_moment(seconds, tmp_path):
    path = tmp_path / "a.mcap"
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=ROOT)
    assert writer.stdout.readline()
    time.sleep(seconds)
    killed = time.time()
    writer.kill()
    appended = max(int(line) for line in writer.stdout.read().split())
    writer.wait()
    run = load_run(path)
    np.testing.assert_array_equal(run.n, np.arange(len(run)))
    assert run.metadata.zero_id == "bench" and run.metadata.model_extra["cut_short"]
    assert len(run) <= appended + 10
    # 50 ms of the flush and as much again for a busy machine
    assert killed - run.host_time[-1] < 0.15, (killed - run.host_time[-1], appended, len(run))


def test_memory_stays_flat_over_many_rows(tmp_path):
    log = McapLogWriter(tmp_path / "a.mcap", RunMetadata(), capacity=2000, blueprint=False)
    for index in range(20000):
        log.append(row(index))
    assert len(log._queue) <= 2000
    log.close()
    assert len(load_run(tmp_path / "a.mcap")) == 20000


def test_a_row_wakes_the_thread_once_it_is_due_and_not_before(tmp_path, monkeypatch):
    """Right after an answer, when nobody else wants the interpreter, and before the thread's own time has come."""
    monkeypatch.setattr(mcap_log, "FLUSH_SECONDS", 30.0)
    monkeypatch.setattr(mcap_log, "DUE_SECONDS", 0.5)
    log = McapLogWriter(tmp_path / "a.mcap", RunMetadata(), blueprint=False)

    def written(count, seconds=5.0):
        end = time.monotonic() + seconds
        while log.rows_written < count and time.monotonic() < end:
            time.sleep(0.005)
        return log.rows_written

    log.append(row(0))
    assert written(1) == 1  # the first row is due at once
    log.append(row(1))
    assert written(2, 0.1) == 1
    time.sleep(0.5)
    log.append(row(2))
    assert written(3) == 3
    log.close()


def test_the_file_is_synced_once_a_second_and_at_its_end(tmp_path, monkeypatch):
    """Not with each chunk, which would wear the disk and hold the log up; never more than a second apart."""
    synced = []
    real = os.fsync
    monkeypatch.setattr(mcap_log.os, "fsync", lambda number: (synced.append(time.monotonic()), real(number)))
    log = McapLogWriter(tmp_path / "a.mcap", METADATA, blueprint=False)
    assert len(synced) == 1  # its head
    end = time.monotonic() + 2.5
    index = 0
    while time.monotonic() < end:
        log.append(row(index))
        index += 1
        time.sleep(0.01)
    assert len(synced) == 3
    assert all(after - before >= 0.95 for before, after in pairwise(synced))
    log.close()
    assert len(synced) == 4


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_where_the_blueprint_would_be_is_replaced_where_that_was_asked_alone(tmp_path, overwrite):
    (tmp_path / "a.rbl").write_bytes(b"mine")
    with McapLogWriter(tmp_path / "a.mcap", METADATA, overwrite=overwrite) as log:
        log.append(row(0))
    assert ((tmp_path / "a.rbl").read_bytes() == b"mine") is not overwrite


def other_log(path, rows=7):
    with McapLogWriter(path, METADATA, blueprint=False) as log:
        for index in range(rows):
            log.append(row(index))
    annotate(path, tags=["old"])
    return path.read_bytes()


def test_a_log_that_is_to_be_replaced_stays_until_the_new_one_has_rows(tmp_path):
    path = tmp_path / "a.mcap"
    before = other_log(path)
    log = McapLogWriter(path, METADATA, overwrite=True, blueprint=False)
    assert (tmp_path / "a.mcap.old").read_bytes() == before
    log.close()
    assert path.read_bytes() == before and tags_of(path, METADATA) == ["old"]
    assert {found.name for found in tmp_path.iterdir()} == {"a.mcap", "a.notes.json"}
    with McapLogWriter(path, METADATA, overwrite=True, blueprint=False) as log:
        log.append(row(0))
        _until(lambda: log.rows_written == 1)
        _until(lambda: not (tmp_path / "a.mcap.old").exists())
        assert len(scan_mcap(path).columns["t"]) == 1  # should the host die now
        log.append(row(1))
    assert len(load_run(path)) == 2


def test_a_log_that_a_killed_test_was_to_replace_is_not_lost_to_the_next_one(tmp_path):
    path, old = tmp_path / "a.mcap", tmp_path / "a.mcap.old"
    before = other_log(old)
    there = other_log(path)
    with pytest.raises(WorkError, match=r"a\.mcap\.old: an older log.*rename or remove it first"):
        McapLogWriter(path, METADATA, overwrite=True)
    assert old.read_bytes() == before and path.read_bytes() == there


def test_the_notes_of_a_replaced_run_are_not_the_new_ones(tmp_path):
    path, notes = tmp_path / "a.mcap", tmp_path / "a.notes.json"
    other_log(path)
    said = notes.read_bytes()
    with McapLogWriter(path, METADATA, overwrite=True, blueprint=False) as log:
        log.append(row(0))
        log.append(row(1))
    assert tags_of(path, METADATA) == [] and (tmp_path / "a.notes.json.old").read_bytes() == said
    annotate(path, tags=["of the new one"])
    export_run(full_run(100), path, overwrite=True)
    assert tags_of(path, METADATA) == []
    annotate(path, tags=["of both"])
    for form in ("csv", "csv", "mcap"):  # one run in two forms, written again
        export_run(load_run(path), tmp_path / f"a.{form}", overwrite=True)
    assert tags_of(path, METADATA) == ["of both"]


def test_a_log_whose_head_finds_no_room_leaves_the_one_that_it_was_to_replace(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    before = other_log(path)
    for error, raised in ((OSError(errno.ENOSPC, "No space left on device"), WorkError),
                          (KeyboardInterrupt(), KeyboardInterrupt)):
        with monkeypatch.context() as patch:
            patch.setattr(mcap_log._Pieces, "sync", lambda self, error=error: (_ for _ in ()).throw(error))
            with pytest.raises(raised):
                McapLogWriter(path, METADATA, overwrite=True)
        assert path.read_bytes() == before and not (tmp_path / "a.mcap.old").exists()
