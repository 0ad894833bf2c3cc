"""The measures of a diagnosis against values worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from station.diagnose.measures import floor, measures, nrmse, repeats, step_figures, step_measures
from station.diagnose.result import RunComparison
from station.model.simulate import Simulation
from station.runs.run import Run, RunMetadata
from station.runs.step_response import overshoot, settling_time, step_row

T = np.arange(10) * 0.01
STEP = np.array([0, 0, 50, 50, 50, 50, 50, 50, 50, 50], dtype=float)
ANSWER = np.array([0, 0, 0, 30, 60, 55, 49, 48, 50, 50], dtype=float)
OPEN, LOOP = {"kind": "open"}, {"kind": "p", "gain": 2.0}


def made(reference: np.ndarray, encoder: np.ndarray, controller: dict = LOOP, accel: np.ndarray | None = None) -> Run:
    return Run("run", np.arange(len(reference)) * 0.01, reference, np.zeros(len(reference)), encoder, accel,
               RunMetadata(controller=controller))


def test_overshoot_is_the_peak_over_the_step():
    assert step_row(STEP) == 2
    assert overshoot(STEP, ANSWER) == pytest.approx(20.0)  # 100 (60 - 50) / 50


def test_settling_is_the_last_time_outside_two_percent_from_the_step():
    # +-1 count about 50: row 7 (48) is the last outside, row 6 (49) is inside; the step is in row 2.
    assert settling_time(STEP, ANSWER, T) == pytest.approx(0.05)


def test_an_answer_that_stays_below_its_reference_has_a_negative_overshoot():
    assert overshoot(STEP, np.minimum(ANSWER, 45.0)) == pytest.approx(-10.0)


def test_a_step_down_is_the_step_up_turned_over():
    assert overshoot(-STEP, -ANSWER) == pytest.approx(20.0)
    assert settling_time(-STEP, -ANSWER, T) == pytest.approx(0.05)


def test_a_step_between_two_levels_counts_from_the_level_before():
    # 30 -> 10: smallest 7 is 3 beyond, of 20.
    reference = np.array([30, 30, 10, 10, 10, 10], dtype=float)
    encoder = np.array([30, 30, 28, 7, 10, 10], dtype=float)
    assert overshoot(reference, encoder) == pytest.approx(15.0)
    assert settling_time(reference, encoder, np.arange(6) * 0.01) == pytest.approx(0.01)
    # A peak from before the step is not of the step; one above both levels is no overshoot downwards.
    assert overshoot(reference, np.array([30, 45, 28, 12, 10, 10], dtype=float)) == pytest.approx(0.0)


def test_settling_is_null_where_the_run_ends_outside_and_zero_where_it_never_leaves():
    still_out = ANSWER.copy()
    still_out[-1] = 52.0
    assert settling_time(STEP, still_out, T) is None
    assert settling_time(STEP, STEP, T) == 0.0
    # The edge belongs to the inside.
    edge = STEP.copy()
    edge[5] = 51.0
    assert settling_time(STEP, edge, T) == 0.0
    edge[5] = 51.5
    assert settling_time(STEP, edge, T) == pytest.approx(0.03)


@pytest.mark.parametrize("reference", [np.zeros(10), np.arange(10.0), np.array([0, 5, 5, 0, 0, 0, 0, 0, 0, 0.0])],
                         ids=["none", "ramp", "pulse"])
def test_what_is_no_single_step_has_no_step_measures(reference):
    assert step_row(reference) is None
    assert overshoot(reference, ANSWER) is None
    assert settling_time(reference, ANSWER, T) is None
    assert step_measures(made(reference, ANSWER), ANSWER) == {}


def test_an_open_loop_step_has_no_step_measures():
    assert step_measures(made(STEP, ANSWER, OPEN), ANSWER) == {}
    assert step_measures(made(STEP, ANSWER), ANSWER) == {"overshoot_percent": pytest.approx(20.0),
                                                         "settling_time": pytest.approx(0.05)}


def test_a_diagnosis_tells_the_rise_of_a_step_beside_the_contracts_measures():
    # 10 % (5) lies a sixth of the way from row 2 (0) to row 3 (30), 90 % (45) half way from there to row 4 (60).
    found = step_figures(made(STEP, ANSWER), ANSWER)
    assert found == {**step_measures(made(STEP, ANSWER), ANSWER), "rise_time": pytest.approx(0.01 * (1.5 - 1.0 / 6.0))}
    assert step_figures(made(STEP, ANSWER, OPEN), ANSWER) == {}


def test_repeats_say_what_a_simulation_that_knows_all_but_chance_would_leave():
    """Four runs of one motion, each with its own noise: the true motion's nrmse is what they differ by."""
    rng, rows = np.random.default_rng(5), 4000
    reference, true = np.where(np.arange(rows) < 100, 0.0, 50.0), 40.0 * np.sin(np.linspace(0.0, 60.0, rows))
    noise = rng.normal(0.0, 1.5, (4, rows))
    noise[:, 0] = 0.0           # each counts from where it begins
    runs = [made(reference, true + e + 7.0 * k, accel=3.0 * true + 2.0 * e + k) for k, e in enumerate(noise)]
    unknown = {"kind": "unknown"}
    other = [made(reference, true, {"kind": "p", "gain": 1.0}), made(-reference, true),
             made(reference, true, unknown), made(reference, true, unknown), made(reference[:1500], true[:1500])]
    found = repeats([*runs, *other])
    wanted = nrmse(true + noise[0], true)
    assert [f["encoder"] for f in found[:4]] == pytest.approx([wanted] * 4, rel=0.03)
    assert [f["accel"] for f in found[:4]] == pytest.approx([2.0 / 3.0 * wanted] * 4, rel=0.03)
    assert found[4:] == [{}] * 5, "another gain, reference or an unknown controller, or less than half of the test"


def test_repeats_of_a_step_say_by_how_much_its_figures_differ():
    """Overshoots of 20, 22 and 27 %, the last never settled."""
    peak = np.arange(len(ANSWER)) == np.argmax(ANSWER)
    answers = [ANSWER + more * peak for more in (0.0, 1.0, 3.5)]
    answers[2][-1] += 10.0
    found = repeats([made(STEP, answer) for answer in answers])
    figures = [step_figures(made(STEP, answer), answer) for answer in answers]
    assert [row["overshoot_percent"] for row in figures] == pytest.approx([20.0, 22.0, 27.0])
    assert [row["settling_time"] is None for row in figures] == [False, False, True]
    for row in found:
        assert row["overshoot_percent"] == pytest.approx(np.std([20.0, 22.0, 27.0], ddof=1))
        assert row["settling_time"] == pytest.approx(
            np.std([figures[0]["settling_time"], figures[1]["settling_time"]], ddof=1))


def test_a_copy_of_a_log_is_no_further_repeat_of_another():
    rng, runs = np.random.default_rng(6), []
    for _ in range(2):
        runs.append(made(STEP, ANSWER + np.append(0.0, rng.normal(0.0, 1.0, len(ANSWER) - 1))))
    copy = replace(runs[1], name="copy")
    both, rows = repeats(runs), repeats([*runs, copy])
    assert rows == [*both, both[1]] and both[0]["encoder"] > 0.0


def test_open_loop_runs_repeat_where_their_commands_do():
    pulse, motion = np.array([0.0, 9.0, 9.0, 0.0, 0.0]), np.array([0.0, 1.0, 4.0, 8.0, 9.0])
    runs = [Run(name, np.arange(5) * 0.01, np.zeros(5), command, motion + 0.5 * moved * (np.arange(5) > 1),
                metadata=RunMetadata(controller=OPEN))
            for name, command, moved in (("a", pulse, 0), ("b", pulse, 1), ("c", -pulse, 0))]
    found = repeats(runs)
    apart = math.sqrt(0.6 * 0.5 * 0.5**2)       # variance of two readings: half their difference's square
    assert found[0] == {"encoder": pytest.approx(apart / np.std(motion))} and set(found[1]) == {"encoder"}
    assert found[2] == {}


def test_nrmse_is_the_error_over_the_spread_about_the_mean():
    # mean 2, spread sqrt(4 + 0 + 4) = sqrt 8; error (0, 1, 1): sqrt 2.
    assert nrmse(np.array([0.0, 2.0, 4.0]), np.array([0.0, 1.0, 5.0])) == pytest.approx(0.5)
    assert nrmse(np.array([0.0, 2.0, 4.0]), np.full(3, 2.0)) == pytest.approx(1.0)
    assert nrmse(ANSWER, ANSWER) == 0.0
    assert nrmse(ANSWER + 1000.0, ANSWER) == pytest.approx(1000.0 * math.sqrt(10) / np.linalg.norm(ANSWER - 34.2))


def test_a_channel_that_never_moves_has_no_finite_nrmse():
    assert nrmse(np.full(5, 3.0), np.full(5, 3.0)) == math.inf
    assert floor(np.full(5, 3.0), 1.0) == math.inf
    still, moves = made(np.zeros(3), np.full(3, 7.0)), made(np.zeros(3), np.array([0.0, 2.0, 4.0]))
    found = Simulation(still.t, still.reference, still.command, np.array([0.0, 1.0, 5.0]), None)
    assert RunComparison(still, found, found, None).errors("encoder") == [None, None, None]
    assert RunComparison(moves, found, found, None).errors("encoder") == pytest.approx([0.5, 0.5, None])


def test_the_floor_is_noise_and_rounding_over_the_same_spread():
    # 3 rows, sigma^2 = 1/4: sqrt(3 (1/4 + 1/12)) = 1 over sqrt 8.
    assert floor(np.array([0.0, 2.0, 4.0]), 0.5) == pytest.approx(1.0 / math.sqrt(8.0))
    assert floor(np.array([0.0, 2.0, 4.0]), 0.0) == pytest.approx(0.5 / math.sqrt(8.0))


def test_a_perfect_simulation_reaches_the_floor():
    """True motion read with noise and rounding: its nrmse against the true motion is the floor."""
    rng = np.random.default_rng(1)
    true = 40.0 * np.sin(np.linspace(0.0, 60.0, 20_000)) + 0.3 * np.linspace(0.0, 60.0, 20_000)
    read = np.floor(true + 1.3 * rng.standard_normal(true.size) + 0.5)
    assert nrmse(read, true) == pytest.approx(floor(read, 1.3), rel=0.02)


def test_comparison_holds_both_channels_and_both_steps():
    accel = np.array([0, 0, 4, 2, -3, -2, 1, 0, 0, 0], dtype=float)
    run = made(STEP, ANSWER, accel=accel)
    found = measures(run, Simulation(run.t, run.reference, run.command, STEP, accel / 2.0), run.logged)
    assert found["run"] == "run"
    assert found["encoder"] == {"nrmse": pytest.approx(nrmse(ANSWER, STEP))}
    assert found["accel"] == {"nrmse": pytest.approx(nrmse(accel, accel / 2.0))}
    assert found["measured"]["overshoot_percent"] == pytest.approx(20.0)
    assert found["simulated"] == {"overshoot_percent": 0.0, "settling_time": 0.0}
    alone = made(STEP, ANSWER)
    assert "accel" not in measures(alone, Simulation(run.t, run.reference, run.command, STEP, None), alone.logged)
