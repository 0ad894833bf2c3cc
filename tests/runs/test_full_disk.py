"""A disk that is full when the files beside a log, and those drawn from it, are written."""

import os
from contextlib import contextmanager

import pytest

from station.errors import WorkError
from station.runs import McapLogWriter, export_run, load_run
from tests.runs.examples import METADATA, full_run

resource = pytest.importorskip("resource", reason="limits of POSIX")
ROOM = 60_000
"""Bytes: more than a log of 200 rows, less than its blueprint."""


@contextmanager
def little_room():
    """No file may grow beyond ROOM bytes; the system then refuses as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_blueprint_that_finds_no_room_is_told_in_one_line_and_left_out(tmp_path, capfd):
    run, words = full_run(200), r"b.rbl: cannot be written \(.*\); the log .*b.mcap is whole without it"
    with little_room(), pytest.raises(WorkError, match=words):
        export_run(run, tmp_path / "b.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"] and len(load_run(tmp_path / "b.mcap")) == 200
    assert capfd.readouterr().err == ""


def test_a_live_log_is_whole_where_its_blueprint_finds_no_room(tmp_path, capfd):
    log = McapLogWriter(tmp_path / "a.mcap", METADATA)
    for index in range(100):
        log.append((index, index / 500.0, *range(10)))
    with little_room(), pytest.raises(WorkError, match=r"a.rbl: cannot be written .*a.mcap is whole without it"):
        log.close()
    assert os.listdir(tmp_path) == ["a.mcap"]
    assert "cut_short" not in load_run(tmp_path / "a.mcap").metadata.entries()
    assert capfd.readouterr().err == ""


def test_a_recording_that_finds_no_room_is_told_in_one_line(tmp_path, capfd):
    with little_room(), pytest.raises(WorkError, match=r"^\S*e.rrd: cannot be written \([^\n]*\)$"):
        export_run(full_run(2000), tmp_path / "e.rrd")
    assert os.listdir(tmp_path) == []
    assert capfd.readouterr().err == ""
