"""What a run is: its checks, its slices, its rest."""

from dataclasses import replace

import numpy as np
import pytest

from station.device.protocol import LIMITS
from station.errors import WorkError
from station.runs.run import HELD, Run, RunMetadata
from tests.runs.examples import full_run


def plain(rows: int = 30, **changes: object) -> dict:
    columns = {"t": np.arange(rows) / 500.0, "reference": np.zeros(rows), "command": np.zeros(rows),
               "encoder": np.zeros(rows)}
    return columns | changes


def spoiled(name: str, row: int, value: float) -> dict:
    columns = plain(accel=np.zeros(30))
    columns[name] = columns[name].copy()
    columns[name][row] = value
    return columns


@pytest.mark.parametrize("name", ["t", "reference", "command", "encoder", "accel"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_refused_by_column_and_row(name, value):
    with pytest.raises(WorkError, match=rf"^made: column {name}, row 7: .*finite") as caught:
        Run(name="made", **spoiled(name, 7, value))
    assert "\n" not in str(caught.value)


def test_irregular_time_is_refused_by_row():
    with pytest.raises(WorkError, match="^made: column t, row 12: irregular time"):
        Run(name="made", **spoiled("t", 12, 12.5 / 500.0))
    t = np.arange(30) / 500.0
    t[20:] += 1 / 500.0
    with pytest.raises(WorkError, match="column t, row 20: irregular time"):
        Run(name="made", **plain(t=t))


def test_time_that_stands_still_or_runs_backwards_is_refused():
    for t in (np.zeros(30), -np.arange(30) / 500.0):
        with pytest.raises(WorkError, match="time does not rise"):
            Run(name="made", **plain(t=t))


@pytest.mark.parametrize(("changes", "words"), [
    ({"command": np.zeros(29)}, "column command has 29 rows, t has 30"),
    ({"encoder": np.zeros((30, 1))}, "column encoder: one dimension"),
    ({"encoder": ["a"] * 30}, "column encoder: not numbers"),
    ({"n": np.arange(30) + 0.5}, "column n, row 0: 0.5 where a whole number"),
    ({"n": np.zeros(30)}, "column n, row 1: the index does not rise"),
    ({"latency": np.full(30, np.inf)}, "column latency, row 0: inf"),
    ({"extra": {"Bad Name": np.zeros(30)}}, "column name 'Bad Name'"),
    ({"extra": {"metadata": np.zeros(30)}}, "column name 'metadata'"),
])
def test_columns_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(WorkError, match=words):
        Run(name="made", **plain(**changes))


def test_one_row_is_no_run():
    with pytest.raises(WorkError, match="made: 1 rows"):
        Run(name="made", **plain(rows=1))


def test_a_lost_tick_is_counted_and_named_never_filled():
    n = np.delete(np.arange(31), 11)
    run = Run(name="made", **plain(t=n / 500.0, n=n))
    assert run.lost_samples == 1 and run.sample_rate == 500.0 and len(run) == 30
    with pytest.raises(WorkError, match="1 samples lost, the first before row 11"):
        run.require_unbroken()
    run.slice(0, 11).require_unbroken()


def test_a_gap_is_filled_with_the_command_in_force_and_its_rows_are_marked():
    n = np.delete(np.arange(31), [11, 12])
    run = Run(name="made", **plain(t=n / 500.0, n=n, command=10.0 * n, encoder=3.0 * n, reference=1.0 * n))
    whole = run.filled()
    assert whole.lost_samples == 0 and len(whole) == 31 and whole.sample_rate == run.sample_rate
    np.testing.assert_array_equal(np.flatnonzero(~whole.logged), [11, 12])
    np.testing.assert_array_equal(whole.command[10:14], [100.0, 100.0, 100.0, 130.0])
    np.testing.assert_allclose(whole.encoder, 3.0 * np.arange(31))
    np.testing.assert_array_equal(whole.command[whole.logged], run.command)
    whole.require_unbroken()
    assert run.logged.all() and run.slice(0, 11).filled().name == "made"


def test_a_log_of_every_other_tick_is_spread_over_them_with_the_commands_between_on_a_straight_line():
    rows = np.arange(31)
    run = Run(name="made", **plain(t=rows / 250.0, command=10.0 * rows, encoder=3.0 * rows, reference=1.0 * rows,
                                   latency=1e-4 + 0.0 * rows))
    whole = run.filled(500.0)
    assert len(whole) == 61 and whole.sample_rate == 500.0 and whole.lost_samples == 0
    np.testing.assert_array_equal(np.flatnonzero(~whole.logged), np.arange(1, 61, 2))
    np.testing.assert_allclose(whole.command, 5.0 * np.arange(61))
    np.testing.assert_allclose(whole.encoder, 1.5 * np.arange(61))
    assert np.isnan(whole.latency[1::2]).all() and not np.isnan(whole.latency[::2]).any()
    assert run.filled(250.0) is run and run.filled(600.0) is run


def test_a_row_that_a_log_of_every_other_tick_lost_is_lost_there_too():
    n = np.delete(np.arange(31), [11])
    whole = Run(name="made", **plain(t=n / 250.0, n=n)).filled(500.0)
    assert len(whole) == 61
    np.testing.assert_array_equal(np.flatnonzero(~whole.logged), sorted({*range(1, 61, 2), 22}))


def test_what_acted_in_a_gap_is_known_as_long_as_a_device_holds_a_command():
    assert LIMITS["hold_ticks_max"] == HELD
    rows = np.delete(np.arange(60), [0, *range(10, 10 + HELD), *range(30, 31 + HELD)])
    columns = {name: values[rows] for name, values in plain(60).items()}
    filled = Run(name="made", **columns, n=rows.astype(float)).filled()
    assert np.array_equal(np.flatnonzero(filled.blank), np.arange(29, 30 + HELD))
    assert not filled.slice(0, 29).blank.any() and filled.slice(32).blank[:3].sum() == 0, "a shorter rest of it"


def test_a_run_that_lost_more_than_it_logged_is_refused():
    n = np.array([0, 1, 2, 900])
    with pytest.raises(WorkError, match="897 samples lost and 4 logged"):
        Run(name="made", **plain(rows=4, t=n / 500.0, n=n)).filled()


def test_a_slice_keeps_time_every_column_and_metadata():
    run = full_run()
    part = run.slice(5, 25)
    assert len(part) == 20 and part.sample_rate == run.sample_rate and part.metadata is run.metadata
    for name, values in run.columns().items():
        np.testing.assert_array_equal(part.columns()[name], values[5:25])


@pytest.mark.parametrize(("entries", "words"), [
    ({"command_row": 1}, "command_row"), ({"command_row": -9}, "command_row"), ({"start": "thrown"}, "start"),
    ({"controller": []}, "controller"), ({"accel_zero": float("nan")}, "accel_zero"),
])
def test_metadata_that_say_the_impossible_are_refused_by_key(entries, words):
    with pytest.raises(WorkError, match=rf"^f.mcap: metadata {words}: ") as caught:
        RunMetadata.from_entries("f.mcap", entries)
    assert "\n" not in str(caught.value)


def test_a_log_that_names_no_controller_has_an_unknown_one_whose_loop_is_told_by_its_commands():
    run = Run(name="r", metadata=RunMetadata(), **plain())
    assert run.metadata.controller == {"kind": "unknown"}
    told = {kind: RunMetadata(controller={"kind": kind}) for kind in ("open", "unknown", "p")}
    for same in (True, False):
        command = run.reference if same else run.reference + 1.0
        found = {kind: replace(run, command=command, metadata=meta).open_loop for kind, meta in told.items()}
        assert found == {"open": True, "unknown": same, "p": False}


def test_unknown_metadata_are_kept():
    metadata = RunMetadata.from_json("f", '{"operator": {"name": "A"}, "rig": "sflr", "left": null}')
    assert RunMetadata.from_json("f", metadata.to_json()) == metadata
    assert metadata.entries()["operator"] == {"name": "A"} and metadata.entries()["left"] is None


@pytest.mark.parametrize("text", ["{", "[1]", '{"a": NaN}', '{"a": Infinity}', '{"a": 1e400}', "[" * 100000,
                                  '"' + "x" * 2_000_000])
def test_metadata_that_are_not_plain_json_are_refused_in_one_line(text):
    with pytest.raises(WorkError, match=r"^f: metadata") as caught:
        RunMetadata.from_json("f", text)
    assert len(str(caught.value)) < 200
