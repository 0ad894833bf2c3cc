"""Runs as an estimator sees them."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np

from station.estimation.dataset import SEGMENTS, canonical_order, dataset
from tests.estimation.made import AXIS, runs_of


def test_the_order_of_runs_is_their_contents_whatever_the_order_given() -> None:
    runs = runs_of(AXIS)
    wanted = [runs[i].name for i in canonical_order(runs)]
    for seed in range(6):
        mixed = list(runs)
        random.Random(seed).shuffle(mixed)
        assert [mixed[i].name for i in canonical_order(mixed)] == wanted
    renamed = [replace(run, name=f"z{3 - i}") for i, run in enumerate(runs)]
    assert canonical_order(renamed) == canonical_order(runs)


def test_stretches_cover_every_row_once_and_none_spans_two_runs() -> None:
    data = dataset(AXIS, runs_of(AXIS))
    assert data.channels == 1 and not data.has_accel
    for r, own in enumerate(data.segment):
        assert len(own) == len(data.runs[r]) and np.all(np.diff(own) >= 0) and np.all(np.diff(own) <= 1)
        assert np.all(data.segment_run[own] == r)
    assert np.array_equal(np.unique(np.concatenate(data.segment)), np.arange(len(data.segment_run)))
    assert len(data.segment_run) <= SEGMENTS


def test_rows_outside_a_window_hold_no_errors() -> None:
    runs = runs_of(AXIS)
    windows = [slice(0, 200), slice(300, None), slice(None)]
    data, whole = dataset(AXIS, runs, windows), dataset(AXIS, runs)
    for window, own, full in zip(windows, data.share, whole.share, strict=True):
        inside = np.zeros(full.shape[1], dtype=bool)
        inside[window] = True
        assert np.array_equal(own[:, inside], full[:, inside]) and not own[:, ~inside].any()


def test_runs_share_a_zero_only_where_they_say_so() -> None:
    runs = runs_of(AXIS)
    apart = [replace(run, metadata=run.metadata.model_copy(update={"zero_id": None})) for run in runs]
    assert dataset(AXIS, runs).zero_group == (0, 0, 0) and dataset(AXIS, apart).zero_group == (0, 1, 2)
