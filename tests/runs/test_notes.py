"""Notes and tags, filters of a folder, cuts: the logs themselves are never written again."""

import hashlib

import numpy as np
import pytest

from station.errors import UsageError, WorkError
from station.runs import RunFilter, RunMetadata, annotate, export_run, list_runs, load_run, trim
from station.runs.notes import notes_of, notes_path, tags_of
from station.runs.run import Run
from tests.runs.examples import full_run


def made(rows=500, rest=100, **metadata):
    run = full_run(rows)
    reference = np.where(np.arange(rows) < rest, 0.0, 50.0)
    encoder = np.where(np.arange(rows) < rest, 0.0, np.minimum(np.arange(rows) - rest, 60.0))
    return Run("made", run.t, reference, np.zeros(rows), encoder, metadata=RunMetadata(**metadata),
               n=np.arange(rows))


@pytest.fixture
def folder(tmp_path):
    for name, entries in {
            "a": {"rig": {"name": "sflr"}, "test": {"kind": "step"}, "controller": {"kind": "p", "gain": 2.0},
                  "began": "2026-03-30T08:00:00Z", "tags": ["good"], "plan": "day.0123", "outcome": "complete"},
            "b": {"rig": "axis", "test": {"kind": "step"}, "began": "2026-03-31T23:59:00Z", "note": "belt loose"},
            "c": {"rig": {"name": "sflr"}, "test": {"kind": "sweep"}, "controller": {"kind": "lead"},
                  "began": "2026-04-01T00:00:00Z", "outcome": "interrupted"}}.items():
        export_run(made(**entries), tmp_path / f"{name}.mcap")
    (tmp_path / "bad.mcap").write_bytes(b"not a log")
    return tmp_path


@pytest.mark.parametrize(("asked", "names"), [
    ({}, {"a", "b", "c", "bad"}), ({"rig": "sflr"}, {"a", "c"}), ({"kind": "step"}, {"a", "b"}),
    ({"controller": "unknown"}, {"b"}), ({"tag": "good"}, {"a"}), ({"plan": "day"}, {"a"}),
    ({"plan": "day.0123"}, {"a"}),
    ({"since": "2026-03-31"}, {"b", "c"}), ({"until": "2026-03-31"}, {"a", "b"}),
    ({"since": "2026-03-31", "until": "2026-03-31"}, {"b"}), ({"since": "20260331"}, {"b", "c"}),
    ({"until": "20260331"}, {"a", "b"}), ({"since": "2026-03-31T23:59"}, {"b", "c"}),
    ({"until": "2026-03-31T23:59:00+02:00"}, {"a"}), ({"until": "2026-03-31T23:59:00Z"}, {"a", "b"}),
    ({"rig": "sflr", "kind": "step"}, {"a"}),
    ({"tag": "bad"}, set())])
def test_a_folder_is_filtered(folder, asked, names):
    wanted = RunFilter(**asked)
    assert {run.name for run in list_runs(folder) if wanted.takes(run)} == names


@pytest.mark.parametrize("date", ["yesterday", "2026-W40", "2026-13-01", ""])
def test_a_date_that_is_none_is_refused(date):
    with pytest.raises(UsageError, match=f"--since {date}: a date such as"):
        RunFilter(since=date)


def test_a_run_that_does_not_say_when_it_began_is_in_no_span_of_time(tmp_path):
    export_run(made(), tmp_path / "a.mcap")
    export_run(made(began="yesterday"), tmp_path / "b.mcap")
    for asked in ({"since": "2000-01-01"}, {"until": "2100-01-01"}):
        assert not [run.name for run in list_runs(tmp_path) if RunFilter(**asked).takes(run)]


def test_a_run_that_ended_early_says_so_in_the_list(folder):
    states = {run.name: run.state for run in list_runs(folder)}
    assert states["a"] == states["b"] == "" and states["c"] == "interrupted"


def test_notes_and_tags_join_those_of_the_making_and_leave_the_log_alone(folder):
    log = folder / "a.mcap"
    before = hashlib.sha256(log.read_bytes()).hexdigest()
    annotate(log, tags=["clamp", "äöü"], note="tightened")
    annotate(log, tags=["late"], without=["clamp"], note="again")
    metadata = load_run(log).metadata
    assert tags_of(log, metadata) == ["good", "late", "äöü"]
    assert notes_of(log, metadata) == ["tightened", "again"]
    assert hashlib.sha256(log.read_bytes()).hexdigest() == before
    assert {run.name: run.tags for run in list_runs(folder)}["a"] == ("good", "late", "äöü")
    assert notes_of(folder / "b.mcap", load_run(folder / "b.mcap").metadata) == ["belt loose"]


@pytest.mark.parametrize("tag", ["", "a,b", "x" * 41, "a\nb"])
def test_a_tag_that_is_none_is_refused(folder, tag):
    with pytest.raises(UsageError, match="--tag"):
        annotate(folder / "a.mcap", tags=[tag])
    assert not notes_path(folder / "a.mcap").exists()


@pytest.mark.parametrize("text", ["{", "[]", '{"tags": 1, "notes": []}', '{"tags": [], "notes": ["x"]}', "\xff"])
def test_damaged_notes_are_told_and_hide_no_run(folder, text):
    notes_path(folder / "a.mcap").write_text(text, encoding="latin-1")
    with pytest.raises(WorkError, match="a.notes.json"):
        annotate(folder / "a.mcap", note="x")
    assert notes_path(folder / "a.mcap").read_text(encoding="latin-1") == text
    found = {run.name: run for run in list_runs(folder)}["a"]
    assert found.rows == 500 and "a.notes.json" in found.notes[0]


def test_a_parquet_file_that_a_library_chokes_on_hides_no_other(folder):
    """Column names that are not UTF-8."""
    export_run(made(), folder / "d.parquet")
    data = (folder / "d.parquet").read_bytes()
    (folder / "d.parquet").write_bytes(data.replace(b"reference", b"\xe2\x28\xa1erence"))
    found = {run.path.name: run for run in list_runs(folder)}
    assert "d.parquet" in found["d.parquet"].problem and found["a.mcap"].rows == 500
    with pytest.raises(WorkError, match=r"d.parquet: not a readable Parquet file"):
        load_run(folder / "d.parquet")


def test_whatever_a_reader_raises_one_bad_file_hides_none(folder, monkeypatch):
    from station.runs import store

    def breaks(path):
        raise RuntimeError("a library's own fault")

    export_run(made(), folder / "e.csv")
    monkeypatch.setitem(store.READERS, ".csv", breaks)
    found = {run.path.name: run for run in list_runs(folder)}
    assert "a library's own fault" in found["e.csv"].problem and found["a.mcap"].rows == 500


def test_a_cut_keeps_rows_time_and_index_and_says_where_it_is_from(folder):
    cut = trim(folder / "a.mcap", folder / "cut.mcap", 0.1, 0.6)
    whole, again = load_run(folder / "a.mcap"), load_run(folder / "cut.mcap")
    assert len(cut) == len(again) == 251
    np.testing.assert_array_equal(again.t, whole.t[50:301])
    np.testing.assert_array_equal(again.n, whole.n[50:301])
    said = again.metadata.entries()["trimmed"]
    assert (said["file"], said["from"], said["to"]) == ("a.mcap", pytest.approx(0.1), pytest.approx(0.6))
    assert said["sha256"] == hashlib.sha256((folder / "a.mcap").read_bytes()).hexdigest()


@pytest.mark.parametrize(("begin", "end", "words"), [(0.3, None, "the arm moves"), (2.0, None, "no two rows"),
                                                     (0.5, 0.4, "no two rows")])
def test_a_cut_that_leaves_nothing_or_begins_in_motion_is_refused(folder, begin, end, words):
    with pytest.raises(UsageError, match=words):
        trim(folder / "a.mcap", folder / "cut.mcap", begin, end)
    assert not (folder / "cut.mcap").exists()


def test_a_cut_never_replaces_its_source(folder):
    with pytest.raises(WorkError, match="exists already"):
        trim(folder / "a.mcap", folder / "a.mcap", 0.0, 0.5)
