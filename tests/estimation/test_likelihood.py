"""What errors are worth: counted against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from station.estimation.likelihood import cost, independent_errors, rho, temperature

ROWS = 20_000


@pytest.mark.parametrize("seed", range(3))
def test_white_errors_are_all_independent(seed: int) -> None:
    errors = np.random.default_rng(seed).standard_normal(ROWS)
    assert independent_errors(errors, ROWS) == pytest.approx(ROWS, rel=0.02)
    assert independent_errors(errors, 700.0) == pytest.approx(700.0, rel=0.02)


@pytest.mark.parametrize("a", [0.3, 0.6, 0.8, 0.9, -0.6])
def test_errors_that_remember_count_as_bayley_and_hammersley_say(a: float) -> None:
    """r_k = a^|k|, sum r^2 = (1 + a^2)/(1 - a^2)."""
    found = []
    for seed in range(8):
        white = np.random.default_rng(seed).standard_normal(ROWS + 1000)
        found.append(independent_errors(signal.lfilter([1.0], [1.0, -a], white)[1000:], ROWS))
    assert np.mean(found) == pytest.approx(ROWS * (1.0 - a * a) / (1.0 + a * a), rel=0.08)


def test_errors_are_never_more_independent_than_they_are_many() -> None:
    for seed in range(20):
        errors = np.random.default_rng(seed).standard_normal(500)
        assert independent_errors(errors, 500.0) <= 500.0
    assert independent_errors(np.zeros(500), 500.0) == 500.0


def test_the_scale_of_errors_does_not_change_how_many_are_independent() -> None:
    errors = np.cumsum(np.random.default_rng(0).standard_normal(4000))
    assert independent_errors(1e-3 * errors, 4000.0) == pytest.approx(independent_errors(errors, 4000.0), rel=1e-9)


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
    """H and J of y = X b + noise whose likelihood counts every row ``copies`` times; stretches are of one row."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((rows, 3))
    slopes = copies * x * rng.standard_normal(rows)[:, None]
    return copies * x.T @ x, slopes.T @ slopes


def test_independent_scores_have_the_temperature_one() -> None:
    assert temperature(*scores(20_000, 1), np.full(3, 1e-6)) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("copies", [2, 5])
def test_errors_counted_k_times_have_the_temperature_k(copies: int) -> None:
    curvature, scatter = scores(20_000, copies)
    assert temperature(curvature, scatter, np.full(3, 1e-6)) == pytest.approx(copies, rel=0.03)


def test_a_likelihood_that_counts_too_little_is_not_sharpened() -> None:
    curvature, scatter = scores(20_000, 1)
    assert temperature(curvature, 0.2 * scatter, np.full(3, 1e-6)) == 1.0


def test_directions_that_the_prior_holds_do_not_heat_the_others() -> None:
    """The first is seen and its scores are independent; the second, of which ten copies count, the prior holds."""
    found = temperature(np.diag([1e4, 1.0]), np.diag([1e4, 100.0]), np.array([1e-6, 1e4]))
    assert found == pytest.approx(1.0, abs=0.02)
