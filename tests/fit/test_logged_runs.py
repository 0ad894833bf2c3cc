"""Runs as benches log them, of an independent truth: gaps, half the rate, unknown controllers, starts in motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from station.fit import FitResult, fit
from station.rig import Rig
from station.runs.run import Run
from tests.truth import SFLR, make_case, pulse_test, step_test, sweep_test

TESTS = [pulse_test(500.0, 120.0, duration=3.0), step_test(500.0, "p2", 80.0, 3.0),
         sweep_test(500.0, 60.0, 0.5, 12.0, 4.0)]
SCALES = ("beam.mass_per_length", "beam.length")
"""What a balance and a ruler give: what they say is the truth."""
SHARP = {"beam.flexural_rigidity": 0.03, "accelerometer.gain": 0.03, "base.inertia": 0.1}
"""Of constants that the runs say much of, the relative error that is let pass."""
SEED = 14
"""Of a rig whose file is wrong by more than that in all of them."""


@cache
def hidden(seed: int) -> tuple[Rig, Rig, list[Run]]:
    """The truth, the rig file that says of it no more than SCALES, and three runs."""
    case = make_case(seed, [], TESTS, nominal=SFLR)
    truth = Rig.model_validate(case.rig)
    return truth, Rig.model_validate(SFLR).with_constants({p: truth.constants()[p] for p in SCALES}), case.runs


@cache
def plain(seed: int) -> FitResult:
    """The fit of the runs as they are."""
    _, nominal, runs = hidden(seed)
    return fit(nominal, runs, SCALES, starts=1)


def unknown(run: Run) -> Run:
    return replace(run, metadata=run.metadata.model_copy(update={"controller": {"kind": "unknown"}}))


def picked(run: Run, rows: np.ndarray) -> Run:
    return replace(run, **{name: values[rows] for name, values in run.columns().items()})


def with_gaps(run: Run) -> Run:
    return picked(run, np.delete(np.arange(len(run)), [300, 301, 302, 303, 700, 701, 900]))


def at_half_rate(run: Run) -> Run:
    return picked(run, np.arange(0, len(run), 2))


def in_motion(run: Run) -> Run:
    """From the middle of the step's rise on, or of what the pulse set going."""
    return run.slice(75)


def wrong(rig: Rig) -> dict[str, float]:
    """Constants that are not the truth, and by what share."""
    truth = hidden(SEED)[0].constants()
    errors = {path: rig.constants()[path] / truth[path] - 1.0 for path in SHARP}
    return {path: error for path, error in errors.items() if abs(error) > SHARP[path]}


def test_who_closed_the_loop_is_not_asked():
    _, nominal, runs = hidden(SEED)
    assert set(wrong(nominal)) == set(SHARP) and wrong(plain(SEED).rig) == {}
    assert fit(nominal, [unknown(run) for run in runs], SCALES, starts=1).constants == plain(SEED).constants


@pytest.mark.parametrize("logged", [with_gaps, at_half_rate, in_motion])
def test_constants_are_found_from_logs_that_are_not_whole(logged: Callable[[Run], Run]):
    _, nominal, runs = hidden(SEED)
    found = fit(nominal, [logged(run) for run in runs], SCALES, starts=1)
    assert wrong(found.rig) == {}
    assert found.chi2 < 0.05 * found.chi2_nominal


def test_the_order_of_the_runs_is_no_matter():
    _, nominal, runs = hidden(SEED)
    assert fit(nominal, runs[::-1], SCALES, starts=1).constants == plain(SEED).constants


@pytest.mark.long
def test_intervals_hold_the_constants_of_rigs_drawn_from_the_stated_uncertainty():
    seeds = range(11, 27)
    inside = [c.low <= hidden(seed)[0].constants()[c.path] <= c.high for seed in seeds for c in plain(seed).constants]
    assert len(inside) == 16 * 13 and np.mean(inside) > 0.85
    widths = [c.high / c.low for seed in seeds for c in plain(seed).constants if c.path == "beam.flexural_rigidity"]
    assert max(widths) < 1.1, "narrow where the runs speak"
