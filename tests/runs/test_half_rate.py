"""A log of every other tick: what is put between its rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.control.named import NAMED
from station.model.simulate import simulate
from station.rig import load_rig
from station.runs import load_run
from station.runs.run import Run, RunMetadata
from tests.measured import LOGS, measured_log

STEP = {"kind": "step", "amplitude": 80.0, "duration": 1.0}


def logged(kind: str, test: dict | None = None, jump: int = 100, late: int = -1) -> Run:
    """A test of the simulated arm with a step of the reference at a row, all its ticks logged."""
    rig = load_rig("sflr")
    reference = np.where(np.arange(500) >= jump, 80.0, 0.0)
    still = np.zeros(500)
    planned = Run("made", np.arange(500) / 500.0, reference, reference, still, still,
                  RunMetadata(controller=NAMED[kind], command_row=late, test=test or {}, command_limit=200.0))
    made = simulate(rig, planned)
    return replace(planned, encoder=made.encoder, accel=made.accel, command=made.command)


def halved(run: Run) -> Run:
    """Every other row of it."""
    return Run(run.name, *(column[::2] for column in (run.t, run.reference, run.command, run.encoder, run.accel)),
               run.metadata)


def missed(run: Run) -> np.ndarray:
    """Commands between the rows of its half, less those that were sent, counts."""
    filled = halved(run).filled(500.0)
    assert np.array_equal(filled.logged, np.arange(len(filled)) % 2 == 0)
    np.testing.assert_array_equal(filled.command[::2], halved(run).command)
    return filled.command - run.command[: len(filled)]


def straight(run: Run) -> np.ndarray:
    """The same with commands on a straight line."""
    ticks = np.arange(len(run) - 1)
    return np.interp(ticks, ticks[::2], run.command[::2]) - run.command[:-1]


@pytest.mark.parametrize("kind", ["open", "p", "lead"])
@pytest.mark.parametrize("jump", [100, 101])
def test_a_step_begins_between_two_rows_where_the_logs_test_says_so(kind: str, jump: int) -> None:
    run = logged(kind, STEP | {"rest": jump / 500.0}, jump)
    assert np.max(np.abs(missed(run)[90:110])) <= 1.0
    assert np.max(np.abs(straight(run)[90:110])) > 39.0
    if kind == "open":
        assert not missed(run).any()


@pytest.mark.parametrize("test", [None, STEP | {"amplitude": 81.0}, {"kind": "hop"}])
def test_a_reference_that_is_not_the_tests_lies_on_a_straight_line(test: dict | None) -> None:
    run = logged("p", test)
    filled = halved(run).filled(500.0)
    assert filled.reference[99] == 40.0 and filled.reference[101] == 80.0


def test_commands_of_an_unknown_controller_lie_on_a_straight_line() -> None:
    run = logged("lead")
    run = replace(run, metadata=run.metadata.model_copy(update={"controller": {"kind": "unknown"}}))
    np.testing.assert_array_equal(missed(run), straight(run))


@pytest.mark.parametrize("name", [name for name in LOGS if "pulse" not in name])
def test_measured_commands_are_met_better_by_their_compensator_than_by_a_straight_line(name: str) -> None:
    run = load_run(measured_log(name))
    run = run.slice(0, len(run) // 2 * 2)
    assert np.sum(missed(run) ** 2) < np.sum(straight(run) ** 2)


@pytest.mark.parametrize(("kind", "row"), [("p", -1), ("lead", -1), ("lead", 0)])
def test_readings_between_the_rows_are_those_with_which_the_compensator_gave_the_next_command(kind: str, row: int,
                                                                                              ) -> None:
    """A step that the log's test names: all commands between the rows, to the count, where no limit hides them."""
    run = logged(kind, STEP | {"rest": 0.2, "amplitude": 80.0}, late=row)
    off = missed(run)
    inside = np.abs(run.command[: len(off)]) < 200.0
    assert np.mean(off[inside] == 0.0) > 0.97 and np.mean(straight(run)[: len(off)][inside] == 0.0) < 0.8


def test_commands_between_the_rows_stay_within_the_limit() -> None:
    run = logged("lead")
    limit = 0.8 * float(np.max(np.abs(run.command)))
    cut = replace(run, command=np.clip(run.command, -limit, limit),
                  metadata=run.metadata.model_copy(update={"command_limit": limit}))
    assert np.max(np.abs(halved(cut).filled(500.0).command)) <= limit


def test_commands_between_the_rows_have_no_bias() -> None:
    """Half a count, rounded up each time, is one: of a P loop whose readings no logged command tells."""
    run = logged("p", STEP | {"rest": 0.2}, late=0)
    off = missed(run)
    assert np.count_nonzero(off) > 10 and abs(np.mean(off[off != 0.0])) < 0.1


def test_times_that_are_a_little_off_their_ticks_are_on_those_of_the_rig() -> None:
    """Of the longer period they are off by less than a log may be, of the shorter one by more."""
    half = halved(logged("lead"))
    off = 0.015 * 0.004 * np.random.default_rng(1).uniform(-1.0, 1.0, len(half))
    run = replace(half, t=half.t + off)
    filled = run.filled(500.0)
    np.testing.assert_allclose(np.diff(filled.t), 0.5 / run.sample_rate, rtol=1e-9)
    assert filled.t[0] == run.t[0] and len(filled) == 2 * len(run) - 1
