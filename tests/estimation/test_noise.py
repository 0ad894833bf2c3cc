"""Noise is what rests and smooth motions scatter by, and rounding is not counted twice."""

from dataclasses import replace

import numpy as np
import pytest

from station.estimation.noise import (
    ACCEL_DEFAULT,
    QUANTISATION,
    SMOOTH,
    noise_of,
    rest_rows,
    rounding_shares,
    run_by_run,
    scatter,
)
from station.runs.run import Run, RunMetadata


def made(rest: int, sigma: float = 1.0, seed: int = 0, *, rows: int = 600, offset: float = 2.3,
         encoder_sigma: float = 0.0, accel: bool = True) -> Run:
    """Rest, then a step with a large motion that no noise estimate may see."""
    rng = np.random.default_rng(seed)
    reference = np.where(np.arange(rows) >= rest, 80.0, 0.0)
    moving = np.clip(np.arange(rows) - rest, 0, None)
    encoder = np.floor(0.5 * moving + encoder_sigma * rng.standard_normal(rows) + 0.5)
    reading = np.floor(30.0 * np.sin(0.2 * moving) + offset + sigma * rng.standard_normal(rows) + 0.5)
    return Run("run", np.arange(rows) / 500.0, reference, 2.0 * (reference - encoder) * (reference > 0), encoder,
               reading if accel else None, RunMetadata(controller={"kind": "p", "gain": 2.0}))


def test_the_rest_ends_where_something_is_asked_or_moves():
    run = made(100)
    assert rest_rows(run) == 100
    early = run.encoder.copy()
    early[40:] += 3.0
    assert rest_rows(Run("run", run.t, run.reference, run.command, early, run.accel, run.metadata)) == 40
    pushed = run.command.copy()
    pushed[25] = 5.0
    assert rest_rows(Run("run", run.t, run.reference, pushed, run.encoder, run.accel, run.metadata)) == 25


def test_one_count_of_flicker_is_no_motion_and_a_run_at_rest_is_rest_throughout():
    run = made(100)
    flicker = run.encoder.copy()
    flicker[10:100:7] = 1.0
    assert rest_rows(Run("run", run.t, run.reference, run.command, flicker, run.accel, run.metadata)) >= 100
    assert rest_rows(made(600)) == 600


@pytest.mark.parametrize("sigma", [0.8, 1.3, 4.0])
def test_the_accelerometers_noise_is_found_before_rounding(sigma):
    runs = [made(100, sigma, seed) for seed in range(12)]
    (encoder, accel), freedoms = noise_of(runs)
    assert accel == pytest.approx(sigma, rel=0.06)
    assert encoder == 0.0
    assert freedoms == (12 * 99, 12 * 99)


def test_runs_with_different_offsets_do_not_add_noise():
    runs = [made(100, 1.0, seed, offset=20.0 * seed) for seed in range(12)]
    assert noise_of(runs).sigmas[1] == pytest.approx(1.0, rel=0.06)


def test_an_encoder_that_dithers_shows_its_noise():
    runs = [made(100, seed=seed, encoder_sigma=0.45) for seed in range(12)]
    still = [run for run in runs if rest_rows(run) == 100]
    assert len(still) > 6
    assert noise_of(still).sigmas[0] == pytest.approx(0.45, abs=0.06)


@pytest.mark.parametrize("unit", [0.02, 1.0 / 3.0])
def test_an_accelerometer_that_is_logged_in_other_units_has_the_same_noise_in_them(unit):
    """In m/s^2, say: neither is its noise taken for what rounds to nothing, nor is a whole unit the rounding's."""
    counts, few = [made(100, sigma=2.0, seed=seed) for seed in range(8)], made(5)
    logged = [replace(run, accel=unit * run.accel) for run in (*counts, few)]
    assert [run.step("accel") for run in logged] == pytest.approx([unit] * 9)
    assert noise_of(logged[:-1]).sigmas[1] == pytest.approx(unit * noise_of(counts).sigmas[1])
    assert noise_of(logged[-1:]).sigmas[1] == pytest.approx(unit * noise_of([few]).sigmas[1])
    assert counts[0].step("accel") == counts[0].step("encoder") == logged[0].step("encoder") == 1.0
    assert replace(few, accel=few.accel - 0.04).step("accel") == 1.0, "whole but for an offset that was taken off"
    assert replace(few, accel=0.0 * few.accel + 0.04).step("accel") == 1.0
    read = np.random.default_rng(1).standard_normal(600)
    assert 0.0 < replace(few, accel=read).step("accel") < 1e-3 * np.ptp(read)


@pytest.mark.parametrize("sigma", [2.0, 8.0])
def test_a_sensor_whose_noise_never_lets_it_rest_shows_it_as_it_moves(sigma):
    runs = [made(100, seed=seed, encoder_sigma=sigma, rows=2000) for seed in range(3)]
    jolted = [Run(r.name, r.t, r.reference, r.command, r.encoder + 40.0 * (np.arange(2000) % 700 > 650), r.accel,
                  r.metadata) for r in runs]
    assert all(rest_rows(run) < 10 for run in runs)
    assert noise_of(runs).sigmas[0] == pytest.approx(sigma, rel=0.05)
    assert noise_of(jolted).sigmas[0] == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize("late", [0.0003, 0.001])
def test_rows_that_are_logged_a_little_late_or_early_are_noise_in_motion_alone(late):
    """A fine encoder of a servo that is read over a bus: noise of a rest was what its observer fed back in motion."""
    rng, t = np.random.default_rng(5), np.arange(2500) / 250.0
    moving = np.clip(t - 1.0, 0.0, None)
    read = np.clip(moving + late * rng.standard_normal(2500) * (moving > 0.0), 0.0, None)
    angle = 6000.0 * np.where(moving > 0.0, 1.0 - np.cos(2.0 * read), 0.0)
    told = RunMetadata(controller={"kind": "open"})
    run = Run("run", t, 0.0 * t, 100.0 * (moving > 0.0), np.floor(angle + 0.5), None, told)
    speed = 12000.0 * np.median(np.abs(np.sin(2.0 * moving[moving > 0.0])))
    found = noise_of([run])
    assert rest_rows(run) == pytest.approx(250, abs=2)
    assert found.sigmas[0] == pytest.approx(late * speed, rel=0.25)
    on_time = Run("run", t, 0.0 * t, run.command, np.floor(6000.0 * (1.0 - np.cos(2.0 * moving)) + 0.5), None, told)
    assert noise_of([on_time]).sigmas[0] == 0.0


def test_a_scatter_is_as_uncertain_as_its_degrees_of_freedom_say():
    """Of many logs of the same sensor in motion, each by itself: variance of an estimated variance, 2/freedoms."""
    found = [scatter([made(0, seed=seed, encoder_sigma=8.0, rows=400)]) for seed in range(400)]
    variances, freedoms = np.array(found).T
    assert np.ptp(freedoms) == 0.0
    assert np.var(variances / np.mean(variances)) == pytest.approx(2.0 / freedoms[0], rel=0.2)


@pytest.mark.parametrize("speed", [0.003, 0.01, 0.03, 0.1, 0.3])
@pytest.mark.parametrize("motion", ["ramp", "swing"])
def test_rounding_is_as_large_by_the_rows_that_count_as_by_all(speed, motion):
    """Where an encoder leaves a count its error is half a count; slow motion would look like more than rounding."""
    rows = np.arange(20_000)
    angle = speed * rows if motion == "ramp" else 2000.0 * speed * np.sin(rows / 2000.0)
    read = np.round(angle + 0.3)
    shares, squares = rounding_shares(read), (angle + 0.3 - read) ** 2
    assert np.sum(shares * squares) / np.sum(shares) == pytest.approx(QUANTISATION, rel=0.12)


@pytest.mark.parametrize("few", [2, 5, 8])
def test_a_run_of_too_few_rows_says_nothing_of_noise(few):
    """The differences that would show it take nine rows; a longer run beside it counts alone."""
    run = made(100, seed=1, encoder_sigma=8.0, rows=2000)
    short = Run("short", run.t[:few], run.reference[:few], run.command[:few], run.encoder[:few], None, RunMetadata())
    assert scatter([short]) == (0.0, 0.0)
    assert scatter([run, short])[0] == pytest.approx(64.0, rel=0.1)


@pytest.mark.parametrize("speed", [0.05, 0.5, 0.51, 3.7])
def test_rounding_is_no_noise_however_fast_an_encoder_moves(speed):
    rows = np.arange(2000)
    run = Run("run", rows / 500.0, np.sin(rows), np.sin(rows), np.round(speed * rows), None, RunMetadata())
    swing = Run("run", rows / 500.0, np.sin(rows), np.sin(rows), np.round(300.0 * np.sin(speed * rows / 30.0)), None,
                RunMetadata())
    assert scatter([run]) == (0.0, 0.0) and noise_of([run, swing]).sigmas[0] == 0.0


def test_a_silent_sensor_has_no_noise_but_its_rounding():
    assert noise_of([made(100, 0.0)]).sigmas == (0.0, 0.0)


def test_without_a_rest_the_default_stands_and_rests_on_one_row():
    assert noise_of([made(5, 3.0), made(0, 3.0)]) == ((0.0, pytest.approx(ACCEL_DEFAULT)), (1.0, 1.0))
    # One run with a rest is enough, whatever the others do.
    (_, accel), freedoms = noise_of([made(5, 3.0), made(400, 3.0)])
    assert accel == pytest.approx(3.0, rel=0.15) and freedoms == (399.0, 399.0)


def test_a_rig_without_accelerometer_rests_on_its_encoder():
    found = noise_of([made(100, accel=False, encoder_sigma=0.0)])
    assert found == ((0.0, pytest.approx(ACCEL_DEFAULT)), (99.0, 1.0))


@pytest.mark.parametrize("rate", [1, 2, 10])
def test_a_stay_at_one_count_says_as_much_at_any_rate_a_rest_one_and_of_a_fast_motion_every_sample(rate):
    rest = np.full(500 * rate, 3.0)
    slow = np.repeat(np.arange(100.0), 20 * rate)
    assert rounding_shares(rest).sum() == pytest.approx(1.0)
    assert rounding_shares(slow).sum() == pytest.approx(98.0 * SMOOTH + 2.0)
    assert np.all(rounding_shares(np.floor(0.4 * np.arange(500)))[3:-3] == 1.0)


def test_a_reading_that_toggles_between_two_counts_rests():
    """The angle stands where one count becomes the next, and a sensor's noise, or a motor that hums, chooses."""
    rng = np.random.default_rng(3)
    toggling = np.round(2.5 + 0.1 * rng.standard_normal(500))
    assert np.count_nonzero(np.diff(toggling)) > 100 and rounding_shares(toggling).sum() == pytest.approx(2.0)
    # A slow turn that toggles at every count moves: as fast as the same without noise.
    turn = 0.05 * np.arange(2000)
    noisy = rounding_shares(np.round(turn + 0.1 * rng.standard_normal(2000)))
    assert noisy.sum() == pytest.approx(rounding_shares(np.round(turn)).sum(), rel=0.1)
    # To and fro by several counts: all but what a play of one count takes at each turning point.
    swing = np.round(8.0 * np.sin(2.0 * np.pi * np.arange(1000) / 200.0))
    assert rounding_shares(swing).mean() > 0.6


def test_rows_that_were_put_into_gaps_are_no_readings():
    """A log of every other tick: what lies between two readings scatters less than they do."""
    whole = made(2000, 3.0, rows=2400)
    half = Run("half", whole.t[::2], whole.reference[::2], whole.command[::2], whole.encoder[::2], whole.accel[::2],
               whole.metadata, n=np.arange(0, 2400, 2))
    filled = half.filled()
    assert len(filled) > 1.9 * len(half)
    (_, accel), freedoms = noise_of([filled])
    assert accel == pytest.approx(3.0, rel=0.06) and freedoms == (999.0, 999.0)


def test_runs_whose_rests_scatter_alike_have_one_noise():
    told = [run_by_run([made(rest, seed=9 * k + r) for r, rest in enumerate((40, 100, 200, 150, 20))])[0]
            for k in range(60)]
    assert sum(np.all(share == 1.0) for share in told) >= 56, "one in a hundred is told apart by chance"
    assert run_by_run([made(100)])[0] == run_by_run([made(100, accel=False), made(90, accel=False)])[0][0] == 1.0
    assert np.all(run_by_run([made(5), made(4)])[1] == 1.0), "no rest tells anything"


def test_runs_whose_rests_differ_have_each_its_own_noise_as_far_as_the_rest_tells_it():
    sigmas, rests = np.array([0.5, 1.5, 3.0, 1.0, 6.0]), (200, 300, 250, 200, 12)
    runs = [made(rest, sigma, seed) for seed, (rest, sigma) in enumerate(zip(rests, sigmas, strict=True))]
    share, freedoms = run_by_run(runs)
    sizes = np.sqrt(share * (noise_of(runs).sigmas[1] ** 2 + QUANTISATION))
    assert sizes[:4] == pytest.approx(np.sqrt(sigmas**2 + QUANTISATION)[:4], rel=0.15)
    own = np.std(runs[4].accel[:12], ddof=1)
    assert sizes[3] < sizes[4] < own, "twelve rows say little, and the others that so much is rare"
    assert np.all(np.array(rests) - 1.0 < freedoms) and np.all(freedoms < np.array(rests) + 40.0)


def test_a_rest_that_reads_one_count_scatters_by_rounding():
    runs = [made(100, 2.0), made(100, 1.5, 1), replace(made(100, 0.0), accel=np.full(600, 3.0))]
    share, _ = run_by_run(runs)
    assert 0.0 < share[2] < 0.2
