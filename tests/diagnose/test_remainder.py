"""What is left of a fit's errors: noise passes for noise, however many rows were logged, and structure does not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose.remainder import Remainder, remainder
from station.diagnose.thresholds import NOISE

ROWS = 5000
LOGGED = {"all": np.ones(ROWS), "every other": (np.arange(ROWS) % 2 == 0).astype(float),
          "with gaps": (np.random.default_rng(4).random(ROWS) < 0.7).astype(float)}


def left(errors: np.ndarray, logged: np.ndarray) -> Remainder:
    """Of one run whose encoder is read at some rows; errors (n) in units of the noise."""
    data = SimpleNamespace(channels=1, records=[SimpleNamespace(share=logged[None])], noise_freedoms=(1e6, 1.0))
    predictor = SimpleNamespace(data=data, observers=(None,), channel=np.zeros(1, dtype=int))
    return remainder(predictor, SimpleNamespace(residuals=[(errors * np.sqrt(logged))[None]]))


@pytest.mark.parametrize("logged", LOGGED.values(), ids=LOGGED)
def test_white_noise_is_noise_and_a_slow_swing_a_third_as_strong_is_not(logged: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    found = [left(rng.standard_normal(ROWS), logged) for _ in range(60)]
    slow = np.array([one.slow for one in found])
    assert all(one.is_noise for one in found)
    assert abs(slow.mean()) < 0.4 and 0.5 < slow.std() < 1.3
    swing = 0.45 * np.sin(np.linspace(0.0, 40.0, ROWS))
    assert left(rng.standard_normal(ROWS) + swing, logged).slow.max() > NOISE
