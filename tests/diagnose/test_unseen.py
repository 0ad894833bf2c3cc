"""The first-order error of runs left out is exact where the model is linear."""

from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose.estimate import Fit
from station.diagnose.unseen import left_out_chi2, unseen_gain

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
