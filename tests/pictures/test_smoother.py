"""The smoother against plain Gaussian algebra, and the step of a random walk that was made."""

import numpy as np
import pytest

from station.pictures.smoother import System, likeliest, misfit, smooth


def test_likelihood_and_smoother_are_those_of_the_joint_gaussian():
    """All rows stacked into one normal distribution: its density, conditional means and variances, by plain algebra."""
    rng = np.random.default_rng(3)
    n, size, channels = 22, 4, 2
    f = 0.95 * np.linalg.qr(rng.standard_normal((size, size)))[0]
    h, r = rng.standard_normal((channels, size)), np.array([0.3, 0.7])
    root = rng.standard_normal((size, 2))
    start, process, first = 0.5 * np.eye(size), root @ root.T, 4.0 * root @ root.T
    y, forcing = 2.0 * rng.standard_normal((n, channels)), rng.standard_normal((n, size))
    mean, cov = np.zeros((n, size)), np.zeros((n, size, n, size))
    for k in range(n):
        if k == 0:
            cov[0, :, 0] = start
            continue
        mean[k] = f @ mean[k - 1] + forcing[k - 1]
        for j in range(k):
            cov[k, :, j] = f @ cov[k - 1, :, j]
            cov[j, :, k] = cov[k, :, j].T
        cov[k, :, k] = f @ cov[k - 1, :, k - 1] @ f.T + (first if k == 1 else process)
    whole, big = cov.reshape(n * size, n * size), np.kron(np.eye(n), h)
    spread = big @ whole @ big.T + np.diag(np.tile(r, n))
    residual = y.ravel() - big @ mean.ravel()
    density = np.linalg.slogdet(spread)[1] + residual @ np.linalg.solve(spread, residual)
    # The likelihood stops updating a covariance that changes by less than 10^-3 per row; the smoother does not.
    assert misfit(f, h, r, start, process, first, y, forcing) == pytest.approx(density, abs=1e-3)
    gain = whole @ big.T @ np.linalg.inv(spread)
    expected = (mean.ravel() + gain @ residual).reshape(n, size)
    variance = np.diag(whole - gain @ big @ whole).reshape(n, size)
    for watched in range(size):
        x, v = smooth(f, h, r, start, process, first, y, forcing, watched)
        np.testing.assert_allclose(x, expected, atol=1e-9)
        np.testing.assert_allclose(v, variance[:, watched], atol=1e-9)


def test_the_likeliest_step_is_the_one_that_made_the_data():
    """A random walk of a known step, seen through noise: found within a factor of two."""
    rng = np.random.default_rng(8)
    step, rows = 0.03, 4000
    walk = np.cumsum(step * rng.standard_normal(rows))
    noise = np.zeros((2, 2))
    noise[0, 0] = noise[1, 1] = 1.0
    system = System(np.eye(2), np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([0.2, 1.0]), np.zeros((2, 2)), noise)
    y = np.stack([walk + np.sqrt(0.2) * rng.standard_normal(rows), rng.standard_normal(rows)], axis=1)
    assert 0.5 * step < likeliest(system, 1.0, y, np.zeros((rows, 2)), (1.0,))[1] < 2.0 * step
