"""What is said of runs left out is exact where the model is linear; and a cause falls where runs speak against it."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from station.diagnose.estimate import Fit
from station.diagnose.unseen import left_out_chi2, refuted, surprise, unseen_gain
from station.model.effects import Stage

RUNS, ROWS = 4, 30


def linear(size: int, temperature: float = 1.0, seed: int = 3):
    """Runs of y = X b + noise with b of the first column, and their fit of ``size`` columns under a prior."""
    rng = np.random.default_rng(seed)
    designs = [rng.normal(size=(ROWS, 3))[:, :size] for _ in range(RUNS)]
    rng = np.random.default_rng(seed + 1)
    runs = [2.0 * np.random.default_rng(seed).normal(size=(RUNS, ROWS, 3))[r, :, 0] + rng.normal(size=ROWS)
            for r in range(RUNS)]
    prior = np.full(size, 0.5)

    def solve(keep: list[int]) -> np.ndarray:
        matrix = sum((designs[r].T @ designs[r] for r in keep), np.zeros((size, size))) / temperature + np.diag(prior)
        return np.linalg.solve(matrix, sum((designs[r].T @ runs[r] for r in keep), np.zeros(size)) / temperature)
    x = solve(list(range(RUNS)))
    errors = [y - d @ x for y, d in zip(runs, designs, strict=True)]
    layout = SimpleNamespace(prior_precision=prior, prior_mean=np.zeros(size))
    found = Fit(layout, x, np.zeros(RUNS), np.zeros(RUNS), 0.0, np.array([[e @ e] for e in errors]), np.zeros(RUNS),
                np.array([d.T @ d for d in designs]), np.array([d.T @ e for d, e in zip(designs, errors, strict=True)]),
                [], [], [], [])
    left = 0.0
    for r in range(RUNS):
        error = runs[r] - designs[r] @ solve([s for s in range(RUNS) if s != r])
        left += float(error @ error)
    return found, left


@pytest.mark.parametrize("size, temperature", [(1, 1.0), (3, 1.0), (2, 7.0)])
def test_it_is_what_refits_without_each_run_give(size, temperature):
    found, left = linear(size, temperature)
    assert left_out_chi2(found, temperature) == pytest.approx(left, rel=1e-9)
    assert left_out_chi2(found, temperature) > float(found.costs.sum())


def test_a_column_that_is_needed_helps_on_unseen_runs_and_noise_does_not():
    nothing, one, three = (linear(size)[0] for size in (0, 1, 3))
    assert unseen_gain(nothing, one) > 0.3
    assert unseen_gain(one, three) < 0.0 < one.costs.sum() - three.costs.sum()


SIZE, HOW_WELL_SEEN = 8, np.ones(30) / np.sqrt(30.0)


def without_each(sizes: list[float], free: bool, stage: Stage = Stage.TORQUE) -> list[Fit]:
    """Fits without each run of y = b u + noise, with the ``sizes`` b of the runs; b, of one effect, is free or 0."""
    rng = np.random.default_rng(0)
    runs = [b * HOW_WELL_SEEN + rng.normal(size=ROWS) for b in sizes]
    count, precision = int(free), 1.0 / SIZE**2
    designs = [HOW_WELL_SEEN[:, None][:, :count] for _ in runs]
    layout = SimpleNamespace(prior_precision=np.full(count, precision), prior_mean=np.zeros(count),
                             hypothesis=SimpleNamespace(effects=((SimpleNamespace(stage=stage), "there"),) * count))
    found = []
    for r in range(len(runs)):
        rest = [s for s in range(len(runs)) if s != r]
        x = np.array([sum(HOW_WELL_SEEN @ runs[s] for s in rest) / (len(rest) + precision)] * count)
        errors = [y - d @ x for y, d in zip(runs, designs, strict=True)]
        found.append(Fit(layout, x, np.zeros(1), np.zeros(1), 0.0, np.array([[e @ e] for e in errors]),
                         np.zeros(len(runs)), np.array([d.T @ d for d in designs]),
                         np.array([d.T @ e for d, e in zip(designs, errors, strict=True)]), [], [], [], []))
    return found


def test_a_runs_surprise_is_minus_twice_its_log_density_with_the_values_integrated_out():
    sizes = [3.0, 5.0, 4.0]
    rng = np.random.default_rng(0)
    runs = [b * HOW_WELL_SEEN + rng.normal(size=ROWS) for b in sizes]
    known = len(sizes) - 1 + 1.0 / SIZE**2
    mean = sum(HOW_WELL_SEEN @ y for y in runs[:2]) / known
    density = multivariate_normal(mean * HOW_WELL_SEEN, np.eye(ROWS) + np.outer(HOW_WELL_SEEN, HOW_WELL_SEEN) / known)
    expected = -2.0 * density.logpdf(runs[2]) - ROWS * np.log(2.0 * np.pi)
    assert surprise(without_each(sizes, True)[2], 2) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("sizes, falls", [
    pytest.param([5.0, 5.0, 5.0, 5.0, 5.0], False, id="all-agree"),
    pytest.param([0.0, 0.0, 0.0, 0.0, 9.0], True, id="one-alone-says-so"),
    pytest.param([7.0, 7.0, 7.0, -7.0, 7.0], True, id="one-says-the-opposite"),
    pytest.param([12.0, 12.0, 12.0, 3.0, 12.0], False, id="one-says-less"),
])
def test_a_cause_falls_where_a_run_speaks_against_it_and_the_runs_do_not_agree(sizes, falls):
    assert refuted(without_each(sizes, False), without_each(sizes, True)) is falls


@pytest.mark.parametrize("size, others, falls", [
    pytest.param(9.0, 1.0, False, id="much-and-the-others-are-silent"),
    pytest.param(6.0, 1.0, True, id="little-and-the-others-pay-for-it"),
    pytest.param(6.0, -1.0, False, id="little-and-the-others-gain-too"),
])
def test_an_effect_that_one_run_alone_shows_must_show_much(size, others, falls):
    """``others``: what the effect costs the other runs, which hardly see it."""
    runs = [0.0, 0.0, 0.0, size]
    without, found = without_each(runs, False), without_each(runs, True)
    for fit in found:
        fit.normal[:3], fit.gradient[:3] = 0.0, 0.0
        fit.costs[:3] = without[0].costs[:3] + others
    assert surprise(without[3], 3) - surprise(found[3], 3) > 30.0
    assert refuted(without, found) is falls


def test_a_clock_that_a_second_clock_speaks_of_need_not_show_in_the_runs():
    """An effect of which nothing else speaks falls."""
    nothing = [0.0, 0.0, 0.0, 0.0]
    for stage, falls in ((Stage.CLOCK, False), (Stage.TORQUE, True)):
        assert refuted(without_each(nothing, False), without_each(nothing, True, stage)) is falls
