"""What errors are worth: counted against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from station.estimation.likelihood import (
    TAPER,
    blocks_independent,
    correlation,
    cost,
    expected,
    rho,
    tapered,
    temperatures,
)

ROWS = 20_000


@pytest.mark.parametrize("seed", range(3))
def test_white_errors_remember_nothing(seed: int) -> None:
    """The estimate scatters by the root of the number of frequencies."""
    errors = np.random.default_rng(seed).standard_normal(ROWS)
    assert correlation(errors) == pytest.approx(1.0, abs=3.0 / math.sqrt(ROWS / 2))


@pytest.mark.parametrize("a", [0.3, 0.6, 0.8, 0.9, -0.6])
def test_errors_that_remember_count_as_bayley_and_hammersley_say(a: float) -> None:
    """r_k = a^|k|, sum r^2 = (1 + a^2)/(1 - a^2)."""
    found = []
    for seed in range(8):
        white = np.random.default_rng(seed).standard_normal(ROWS + 1000)
        found.append(1.0 / correlation(signal.lfilter([1.0], [1.0, -a], white)[1000:]))
    assert np.mean(found) == pytest.approx((1.0 - a * a) / (1.0 + a * a), rel=0.08)


@pytest.mark.parametrize("size", [2, 3, 40, 1000, 1001])
def test_a_series_fades_in_and_out_as_tukeys_window_does(size: int) -> None:
    np.testing.assert_allclose(tapered(size), signal.windows.tukey(size, TAPER), atol=1e-12)


def test_errors_of_one_slow_swing_hold_a_few_independent_ones() -> None:
    """A smoothed spectrum would count twenty and more."""
    time = np.linspace(0.0, 1.0, 1500)
    assert 1500 / correlation(np.sin(np.pi * time) * time) < 8.0


def test_errors_are_never_more_independent_than_they_are_many() -> None:
    assert all(correlation(np.random.default_rng(seed).standard_normal(500)) >= 1.0 for seed in range(20))
    assert correlation(np.zeros(500)) == 1.0


def test_the_scale_of_errors_does_not_change_how_many_are_independent() -> None:
    errors = np.cumsum(np.random.default_rng(0).standard_normal(4000))
    assert correlation(1e-3 * errors) == pytest.approx(correlation(errors), rel=1e-9)


def blocks(slow: list[float], power: list[float], seed: int = 0) -> tuple[np.ndarray, ...]:
    """S, n, p (runs, 1) and errors of runs: white noise of variance 1, and slow errors of given sizes."""
    rng = np.random.default_rng(seed)
    residuals = [(rng.standard_normal(1500) + size * signal.lfilter([0.02], [1.0, -0.999], rng.standard_normal(1500))
                  / 0.447)[None] for size in slow]
    squares = np.array([[float(np.sum(e**2))] for e in residuals])
    return squares, np.full_like(squares, 1500.0), np.array(power)[:, None], residuals


@pytest.mark.parametrize("share", [1e-4, 1e-3, 1e-2])
def test_the_share_of_what_runs_show_that_a_model_misses_is_found(share: float) -> None:
    power = np.array([[1e3], [1e4], [3e4], [1e5], [1e5]])
    v = 1.0 + share * power
    ratio = v * np.random.default_rng(1).chisquare(400.0, v.shape) / 400.0
    np.testing.assert_allclose(expected(ratio, np.full_like(v, 400.0), power), v, rtol=0.1)


def test_where_all_runs_reach_the_noise_nothing_is_missed_and_all_errors_count() -> None:
    squares, counts, power, residuals = blocks([0.0] * 4, [1e3, 1e4, 1e5, 1e5])
    np.testing.assert_allclose(expected(squares / counts, counts, power), 1.0, atol=0.1)
    found = blocks_independent(squares, counts, power, residuals)
    assert np.all(found <= counts) and np.all(found > 0.85 * counts)


def test_a_run_that_a_model_happens_to_meet_holds_no_more_than_the_others_say() -> None:
    """Four runs are missed slowly by as much of what they show; the fifth shows as much, but only noise is left."""
    squares, counts, power, residuals = blocks([3.0, 3.0, 3.0, 3.0, 0.0], [1e4] * 5)
    found = blocks_independent(squares, counts, power, residuals)
    assert found[-1, 0] < 0.1 * counts[-1, 0]
    still = blocks_independent(squares, counts, np.array([[1e4]] * 4 + [[1.0]]), residuals)
    assert still[-1, 0] > 0.85 * counts[-1, 0]  # the same of one that hardly shows anything is no surprise


def test_the_cost_of_a_mean_square_is_the_noises_up_to_it_and_a_logarithm_beyond() -> None:
    ratios = np.array([0.0, 0.5, 1.0, math.e, 100.0])
    np.testing.assert_allclose(rho(ratios), [0.0, 0.5, 1.0, 2.0, 1.0 + math.log(100.0)])
    step = 1e-6
    assert (rho(np.array(1.0 + step)) - rho(np.array(1.0 - step))) / (2.0 * step) == pytest.approx(1.0, rel=1e-5)


def test_the_cost_of_blocks_weighs_each_by_its_independent_errors_and_a_lost_model_costs_all() -> None:
    squares, counts, independent = np.array([[50.0, 200.0]]), np.array([[100.0, 100.0]]), np.array([[100.0, 7.0]])
    assert cost(squares, counts, independent) == pytest.approx(100.0 * 0.5 + 7.0 * (1.0 + math.log(2.0)))
    assert cost(np.array([[np.inf, 1.0]]), counts, independent) == math.inf
    assert cost(np.array([[np.nan, 1.0]]), counts, independent) == math.inf


def scores(rows: int, copies: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """H (3, 3) and slopes (rows, 3) of y = X b + noise whose likelihood counts every row ``copies`` times; stretches
    are of one row."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((rows, 3))
    return copies * x.T @ x, copies * x * rng.standard_normal(rows)[:, None]


def of_kinds(*kinds: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, float]:
    """Temperatures of blocks of some kinds, with hardly a prior."""
    return temperatures(np.stack([h for h, _ in kinds]), np.stack([g for _, g in kinds], axis=1), np.full(3, 1e-6))


def test_independent_scores_have_the_temperature_one() -> None:
    kinds, whole = of_kinds(scores(20_000, 1), scores(20_000, 1, seed=1))
    assert kinds == pytest.approx(1.0, abs=0.03) and whole == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("copies", [2, 5])
def test_a_kind_whose_errors_are_counted_k_times_has_the_temperature_k_and_no_other_has(copies: int) -> None:
    kinds, whole = of_kinds(scores(20_000, copies), scores(20_000, 1, seed=1))
    assert kinds == pytest.approx([copies, 1.0], rel=0.04)
    assert whole == pytest.approx(1.0, abs=0.05), "once each kind counts as it should"


@pytest.mark.parametrize("copies", [2, 3])
def test_kinds_that_share_their_errors_are_warm_together(copies: int) -> None:
    kinds, whole = of_kinds(*[scores(20_000, 1)] * copies)
    assert kinds == pytest.approx(1.0, abs=0.03)
    assert whole == pytest.approx(copies, rel=0.03)


def test_a_likelihood_that_counts_too_little_is_not_sharpened() -> None:
    curvature, slopes = scores(20_000, 1)
    kinds, whole = of_kinds((curvature, 0.4 * slopes))
    assert whole == 1.0 and np.all(kinds == 1.0)


def test_directions_that_the_prior_holds_do_not_heat_the_others() -> None:
    """The first is seen and its scores are independent; the second, of which ten copies count, the prior holds."""
    slopes = np.random.default_rng(0).standard_normal((20_000, 2)) * np.sqrt([1e4, 100.0]) / math.sqrt(20_000)
    kinds, whole = temperatures(np.diag([1e4, 1.0])[None], slopes[:, None], np.array([1e-6, 1e4]))
    assert whole == pytest.approx(1.0, abs=0.03) and kinds == pytest.approx(1.0, abs=0.03)
