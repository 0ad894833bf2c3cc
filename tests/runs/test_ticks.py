"""Logs of other programs whose times are not quite index / sample_rate: rows lost, stamps that jitter."""

import numpy as np
import pytest
import scipy.io

from station.errors import WorkError
from station.runs import export_run, load_run
from station.runs.ticks import ENOUGH, JITTER, on_ticks
from tests.runs.examples import assert_same

ROWS = 400


def written(path, t, **more):
    """A log in the form that the path's ending names."""
    columns = {"t": t, "reference": np.zeros(len(t)), "command": np.zeros(len(t)), "encoder": np.arange(len(t)), **more}
    if path.suffix == ".mat":
        scipy.io.savemat(path, columns)
    else:
        lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row)
                                      for row in zip(*columns.values(), strict=True))]
        path.write_text("\n".join(lines) + "\n")
    return path


def jittered(share, rows=ROWS, rate=500.0):
    """Stamps that lie up to so much of a period off their ticks."""
    off = np.random.default_rng(3).uniform(-share, share, rows)
    return (np.arange(rows) + off) / rate


@pytest.mark.parametrize("form", [".csv", ".mat"])
def test_rows_that_are_missing_are_counted_from_the_times(form, tmp_path):
    ticks = np.delete(np.arange(ROWS), [60, 61, 200])
    run = load_run(written(tmp_path / f"gaps{form}", 12.5 + ticks / 500.0))
    np.testing.assert_array_equal(run.n, ticks)
    assert (run.lost_samples, run.sample_rate, run.t[0]) == (3, 500.0, 12.5)
    place = "line 62" if form == ".csv" else "row 60"
    assert run.read_as == f"by the times 3 rows are missing, the first before {place}"


@pytest.mark.parametrize("decimals", [3, 4])
def test_times_rounded_to_few_digits_still_tell_the_gaps(decimals, tmp_path):
    ticks = np.delete(np.arange(ROWS), np.arange(100, 350))
    run = load_run(written(tmp_path / "gaps.csv", np.round(ticks / 500.0, decimals)))
    np.testing.assert_array_equal(run.n, ticks)


@pytest.mark.parametrize("form", [".csv", ".mat"])
@pytest.mark.parametrize("share", [0.03, 0.2, 0.32])
def test_stamps_that_jitter_are_taken_at_their_ticks_and_it_is_said(share, form, tmp_path):
    stamps = jittered(share)
    run = load_run(written(tmp_path / f"jitter{form}", stamps))
    np.testing.assert_allclose(run.t, np.arange(ROWS) / 500.0, atol=1e-12)
    np.testing.assert_allclose(run.extra["t_logged"], stamps, atol=1e-8)
    assert run.sample_rate == 500.0 and run.lost_samples == 0
    assert "jitter by up to" in run.read_as and "ticks of 500 Hz" in run.read_as


def test_what_was_said_stays_with_the_run_and_is_not_made_again(tmp_path):
    run = load_run(written(tmp_path / "jitter.csv", jittered(0.2)))
    export_run(run, tmp_path / "a.csv")
    export_run(run, tmp_path / "a.mcap")
    assert_same(run, load_run(tmp_path / "a.csv"))
    assert_same(run, load_run(tmp_path / "a.mcap"))
    assert "jitter" in run._repr_html_()


def test_the_rate_is_that_of_the_stamps_not_one_that_is_wished(tmp_path):
    run = load_run(written(tmp_path / "other.csv", jittered(0.2, rate=487.5)))
    assert run.sample_rate == pytest.approx(487.5, rel=2e-4)


def test_stamps_that_jitter_a_little_tell_lost_rows_too(tmp_path):
    stamps = np.delete(jittered(0.08), [60, 61, 200])
    run = load_run(written(tmp_path / "both.csv", stamps))
    np.testing.assert_array_equal(run.n, np.delete(np.arange(ROWS), [60, 61, 200]))
    assert "3 rows are missing" in run.read_as and "jitter" in run.read_as
    np.testing.assert_allclose(run.t, run.n / 500.0, atol=1e-9)


def test_rows_that_were_counted_bear_more_jitter_beside_gaps(tmp_path):
    kept = np.delete(np.arange(ROWS), [60, 61, 200])
    run = load_run(written(tmp_path / "counted.csv", jittered(0.3)[kept], n=kept + 7000))
    assert run.lost_samples == 3 and run.sample_rate == 500.0
    np.testing.assert_array_equal(run.n, kept + 7000)


def late(rows=ROWS):
    """Regular times of which one is half a period late."""
    t = np.arange(rows) / 500.0
    t[40] += 0.5 / 500.0
    return t


AMBIGUOUS = {
    "a stamp half a period late": (late(), "line 42: irregular time"),
    "jitter of 0.45 of a period": (jittered(0.45), "irregular time"),
    "lost rows among much jitter": (np.delete(jittered(0.3), [60, 61, 200]), "irregular time"),
    "a gap of three periods and a half": (np.delete(np.arange(ROWS) / 500.0, 60) + (np.arange(ROWS - 1) >= 60) * 0.003,
                                          "irregular time"),
    "a clock that drifts": (np.arange(ROWS) / 500.0 * (1.0 + 3e-5 * np.arange(ROWS)), "irregular time"),
    "rows by twos, or every third lost": (np.delete(np.arange(ROWS), np.arange(2, ROWS, 3)) / 500.0, "irregular time"),
    "stamps early and late by turns": ((np.arange(ROWS) + 0.3 * (-1.0) ** np.arange(ROWS)) / 500.0, "irregular time"),
    "a few rows alone": (jittered(0.2, ENOUGH - 1), "irregular time"),
    "no time": (np.zeros(ROWS), "time does not rise"),
}


@pytest.mark.parametrize("case", AMBIGUOUS)
def test_times_that_may_mean_more_than_one_thing_are_refused_with_the_remedy(case, tmp_path):
    t, words = AMBIGUOUS[case]
    with pytest.raises(WorkError, match=words) as caught:
        load_run(written(tmp_path / "bad.csv", t))
    if "irregular" in words:
        assert "s is usual" in str(caught.value)
        assert "add a column n with each row's tick, or resample the log" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_count_is_refused_with_its_own_remedy(tmp_path):
    with pytest.raises(WorkError, match="write t as n / sample_rate"):
        load_run(written(tmp_path / "bad.csv", late(), n=np.arange(ROWS)))


@pytest.mark.parametrize("missing", range(1, ROWS - 1, 7))
def test_a_lost_row_is_never_taken_for_jitter(missing):
    """Wherever it is, even among stamps that jitter as much as is borne."""
    for share in (0.0, 0.1, JITTER):
        t = np.delete(jittered(share), missing)
        found, _ = on_ticks({"t": t})
        assert "n" in found or found["t"] is t


@pytest.mark.parametrize("rate", [500.0, 1000.0 / 3.0])
def test_times_that_are_regular_stay_as_they_are_to_the_last_bit(rate):
    t = 3.0 + np.arange(ROWS) / rate
    for columns in ({"t": t}, {"t": t[::3], "n": np.arange(ROWS)[::3]}):
        found, said = on_ticks(columns)
        assert said is None and found == columns
