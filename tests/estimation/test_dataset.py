"""Runs as an estimator sees them."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

from station.errors import WorkError
from station.estimation.dataset import SEGMENTS, by_content, dataset
from station.estimation.noise import rounding_shares
from station.estimation.record import WARM
from station.model.effects import USUAL_SPEED, effect_class
from station.rig import Rig, load_rig
from station.runs.run import Run
from station.runs.ticks import CLOCKS
from tests.cli.conftest import step_run
from tests.estimation.made import AXIS, run_of, runs_of
from tests.truth import SFLR


def test_the_order_of_runs_is_their_contents_whatever_the_order_given() -> None:
    runs = runs_of(AXIS)
    wanted = [run.name for run in by_content(runs)]
    for seed in range(6):
        mixed = list(runs)
        random.Random(seed).shuffle(mixed)
        assert [run.name for run in by_content(mixed)] == wanted
    renamed = [replace(run, name=f"z{3 - i}") for i, run in enumerate(runs)]
    assert [renamed.index(run) for run in by_content(renamed)] == [runs.index(run) for run in by_content(runs)]


def test_stretches_cover_every_row_once_and_none_spans_two_runs() -> None:
    data = dataset(AXIS, runs_of(AXIS))
    assert data.channels == 1 and not data.has_accel
    for r, own in enumerate(one.segment for one in data.records):
        assert len(own) == len(data.runs[r]) and np.all(np.diff(own) >= 0) and np.all(np.diff(own) <= 1)
        assert np.all(data.segment_run[own] == r)
    every = np.concatenate([one.segment for one in data.records])
    assert np.array_equal(np.unique(every), np.arange(len(data.segment_run)))
    assert len(data.segment_run) <= SEGMENTS


def test_rows_outside_a_window_hold_no_errors() -> None:
    runs = runs_of(AXIS)
    windows = [slice(0, 200), slice(300, None), slice(None)]
    data, whole = dataset(AXIS, runs, windows), dataset(AXIS, runs)
    for window, one, every in zip(windows, data.records, whole.records, strict=True):
        own, full = one.share, every.share
        inside = np.zeros(full.shape[1], dtype=bool)
        inside[window] = True
        assert np.array_equal(own[:, inside], full[:, inside]) and not own[:, ~inside].any()


def test_a_sensor_without_noise_only_rounds_whichever_it_is() -> None:
    """What rounding leaves of a slow reading is one error over all rows at one count, not one in each."""
    rows = np.arange(600)
    run = replace(run_of(AXIS, 60.0, "open", "pulses", 600 / AXIS.sample_rate), accel=np.floor(rows / 100.0))
    rig = Rig.model_validate(SFLR)
    quiet = dataset(rig, [run]).records[0].share[1]
    assert quiet.sum() == pytest.approx(rounding_shares(run.accel).sum()) and quiet.sum() < 30.0
    noise = np.round(2.0 * np.random.default_rng(1).standard_normal(600))
    assert dataset(rig, [replace(run, accel=run.accel + noise)]).records[0].share[1].sum() == 600.0


def test_an_accelerometer_in_other_units_is_counted_by_its_own_step() -> None:
    rig = load_rig("sflr")
    run = step_run(rows=600)
    accel = run.accel + np.round(2.0 * np.random.default_rng(1).standard_normal(600))
    whole, metric = (dataset(rig, [replace(run, accel=unit * accel)]) for unit in (1.0, 0.02))
    assert metric.sigma[1] == pytest.approx(0.02 * whole.sigma[1]) and metric.sigma[0] == whole.sigma[0]
    np.testing.assert_array_equal(metric.records[0].share, whole.records[0].share)


def test_runs_share_a_zero_only_where_they_say_so() -> None:
    runs = runs_of(AXIS)
    apart = [replace(run, metadata=run.metadata.model_copy(update={"zero_id": None})) for run in runs]
    assert dataset(AXIS, runs).zero_groups == (0, 0, 0) and dataset(AXIS, apart).zero_groups == (0, 1, 2)
    assert dataset(AXIS, [*apart, apart[1]]).zero_groups == (0, 1, 2, 1), "a log given twice has one zero"


def test_a_run_begins_in_motion_where_its_first_rows_do_what_a_rig_at_rest_cannot() -> None:
    pulses = run_of(AXIS, 60.0, "open", "pulses", 3.0)
    cuts = [pulses.slice(first) for first in (0, 20, 49, 100, 150)]
    rows = round(WARM * AXIS.sample_rate)
    assert [record.finding.sum() for record in dataset(AXIS, cuts).records] == [0, 0, 0, rows, rows]


def test_the_less_a_beam_rings_at_first_the_sooner_its_state_is_found() -> None:
    rig, run = load_rig("sflr"), step_run(rows=1200)
    rows, most = round(WARM * rig.sample_rate), np.ptp(run.accel)
    still = np.zeros(4000)
    quiet = Run("quiet", np.arange(4000) / rig.sample_rate, still, still, still, still, run.metadata)

    def lost(share: float) -> int:
        rings = share * most * np.exp(-np.arange(1200) / 60.0) * np.sin(0.3 * np.arange(1200))
        rung = replace(run, accel=np.round(run.accel + rings))
        return int(dataset(rig, [quiet, rung]).records[1].finding.sum())
    assert lost(0.0) == 0 < lost(0.25) < lost(0.5) < rows
    assert lost(0.5) - lost(0.25) == pytest.approx(rows * np.log(2.0) / np.log(100.0), rel=0.25)


def test_a_rig_that_an_unknown_torque_turns_at_once_begins_at_rest() -> None:
    """A fine encoder shows what it does within a few rows; a speed it shows as well."""
    fine = AXIS.with_constants({"encoder.counts_per_revolution": 4096.0 * AXIS.encoder.counts_per_revolution})
    pushed = fine.with_effects([effect_class("command_bias")(at="amplifier", offset=0.008 * AXIS.amplifier.limit)])
    run = run_of(pushed, 0.0, "open", "x", 3.0)
    assert np.ptp(run.encoder[:10]) > 20.0
    begun = [dataset(fine, [one]).records[0].in_motion for one in (run, run.slice(100))]
    assert begun == [False, True]


def test_a_step_in_the_first_row_is_no_motion_whatever_the_rigs_gain() -> None:
    for gain in (0.6, 1.0, 1.8):
        rig = AXIS.with_constants({"motor.gain": gain * AXIS.motor.gain})
        run = run_of(rig, 90.0, "p2", "step", 2.0)
        begun = run.slice(int(np.argmax(run.reference != 0.0)))
        assert dataset(AXIS, [begun]).records[0].finding.sum() == 0


def test_a_beam_that_rings_is_in_motion_though_its_base_stands_still() -> None:
    rig, run = load_rig("sflr"), step_run(rows=1200)
    still = np.flatnonzero(np.abs(np.convolve(np.diff(run.encoder), np.ones(10), mode="valid")) == 0.0)
    ringing = next(int(row) for row in still if np.ptp(run.accel[row:row + 10]) > 0.2 * np.ptp(run.accel))
    cut = run.slice(ringing)
    assert len(cut) > 2 * WARM * rig.sample_rate
    assert dataset(rig, [cut]).records[0].in_motion


def test_rows_in_which_the_state_is_found_do_not_count() -> None:
    data = dataset(AXIS, [run_of(AXIS, 60.0, "open", "pulses", 3.0).slice(150)])
    one = data.records[0]
    rows = one.finding.sum()
    assert one.finding[:rows].all() and rows > 0
    assert not one.share[:, : rows].any() and not one.window[: rows].any()
    assert one.share[:, rows:].any()


def test_a_log_of_every_other_tick_of_the_rig_is_one_with_gaps() -> None:
    run = run_of(AXIS, 60.0, "open", "pulses")
    thin = replace(run, **{name: values[::2] for name, values in run.columns().items()})
    data = dataset(AXIS, [thin])
    assert data.runs[0].sample_rate == AXIS.sample_rate
    logged = data.runs[0].logged
    assert not logged[1::2].any() and logged[::2].all()
    assert not data.records[0].share[:, 1::2].any()


def test_two_parts_of_one_run_are_one_test_of_noise_and_clock() -> None:
    run = run_of(AXIS, 60.0, "p2", "x")
    run = replace(run, device_time=run.t, host_time=run.t + 1e-4 * np.random.default_rng(1).random(len(run)))
    half = len(run) // 2
    both = dataset(AXIS, [run, replace(run, name="again")], [slice(0, half), slice(half, None)])
    alone = dataset(AXIS, [run])
    assert both.noise_freedoms == alone.noise_freedoms and both.clock == alone.clock


def test_two_runs_may_differ_in_what_the_motor_does_and_one_may_not() -> None:
    one, other = run_of(AXIS, 60.0, "p2", "x"), run_of(AXIS, 50.0, "p2", "y")
    assert dataset(AXIS, [one]).free.tolist() == [0]
    assert dataset(AXIS, [one, other]).free.tolist() == [0, 2, 3]


def test_a_clock_is_no_surer_for_more_runs_than_its_bias() -> None:
    run = run_of(AXIS, 60.0, "p2", "x")
    runs = [replace(run, encoder=run.encoder + k, device_time=run.t, host_time=run.t + 3.0) for k in range(5)]
    assert dataset(AXIS, runs).clock == (pytest.approx(1.0), CLOCKS)


def test_runs_of_which_one_lacks_the_accelerometer_are_refused() -> None:
    run = step_run()
    with pytest.raises(WorkError, match="b: no accelerometer column, but other runs have one"):
        dataset(load_rig("sflr"), [run, replace(run, name="b", accel=None)])


@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_the_speed_of_the_runs_is_that_of_the_rig_and_not_of_the_sensors_noise(noise: float) -> None:
    rows, rng = np.arange(2000), np.random.default_rng(1)
    angle = 400.0 * np.sin(rows / 100.0)
    rest = np.where(rows < 400, 0.0, angle - angle[400])
    run = run_of(AXIS, 60.0, "open", "pulses", 4.0)
    made = replace(run, t=rows / 500.0, reference=0.0 * rows, command=0.0 * rows,
                   encoder=np.round(rest + noise * rng.standard_normal(rows.size)))
    true = AXIS.angle_per_count * float(np.sqrt(np.mean(np.gradient(rest[401:]) ** 2) * 0.8)) * 500.0
    assert dataset(AXIS, [made]).speed == pytest.approx(true, rel=0.03)


def test_runs_that_never_move_are_taken_for_usual_ones() -> None:
    run = run_of(AXIS, 60.0, "open", "pulses", 1.0)
    assert dataset(AXIS, [replace(run, encoder=0.0 * run.t, command=0.0 * run.t)]).speed == USUAL_SPEED
