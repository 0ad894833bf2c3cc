"""Which causes do the same to a diagnosis' runs: by what fitted sets predict."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose.collinear import collinear
from station.diagnose.thresholds import TOLERANCE
from station.estimation.cause import Causes, Key

LAG, DELAY, BIAS = ("accelerometer_lag", "accelerometer"), ("accelerometer_delay", "accelerometer"), ("bias", "motor")
WEIGHTS, SCALES = np.array([[2.0], [0.5]]), (np.array([[0.3, 0.3, 0.3]]), np.array([[0.1, 0.2]]))
DONE, ACROSS = np.array([[1.0, -2.0, 0.5]]), np.array([[2.0, 1.0, 0.0]])
"""What a cause changes in the first run, and something of its size that has nothing in common with it."""


def search(**changes: tuple[Causes, np.ndarray]) -> SimpleNamespace:
    """Fits of sets that change so much of the first run, nothing of the second."""
    fits = {keys: SimpleNamespace(predicted=[change, np.zeros((1, 2))], blocks=lambda weighing: WEIGHTS)
            for keys, change in changes.values()}
    return SimpleNamespace(fits=fits, compared=None, predictor=SimpleNamespace(scale=lambda run: SCALES[run]))


def others(rest: set[Key], other: np.ndarray, best: np.ndarray = DONE) -> Causes:
    """What does the same as LAG beside the rest."""
    shared = frozenset(rest)
    return collinear(search(without=(shared, np.zeros((1, 3))), best=(shared | {LAG}, best),
                            other=(shared | {DELAY}, other)), shared | {LAG}, LAG)


@pytest.mark.parametrize("rest", [set(), {BIAS}])
def test_a_cause_that_changes_the_predictions_as_another_does_is_one_with_it(rest: set[Key]) -> None:
    assert others(rest, DONE) == {DELAY}
    assert others(rest, 0.9 * DONE) == {DELAY}
    assert others(rest, ACROSS) == others(rest, 0.0 * DONE) == frozenset()


def test_the_share_that_it_does_not_do_decides() -> None:
    size = np.linalg.norm(DONE) / np.linalg.norm(ACROSS)
    apart = size * np.sqrt(TOLERANCE) * ACROSS
    assert others(set(), DONE + 0.99 * apart) == {DELAY}
    assert others(set(), DONE + 1.01 * apart) == frozenset()


def test_what_was_not_fitted_beside_all_others_is_held_against_it_beside_fewer() -> None:
    """The largest set in which both were fitted says it."""
    whole = frozenset({LAG, BIAS})
    fits = {"nothing": (frozenset(), np.zeros((1, 3))), "lag": (frozenset({LAG}), DONE), "best": (whole, DONE),
            "delay": (frozenset({DELAY}), DONE)}
    assert collinear(search(**fits), whole, LAG) == {DELAY}
    assert collinear(search(**fits | {"delay": (frozenset({DELAY}), ACROSS)}), whole, LAG) == frozenset()
    beside = {"bias": (frozenset({BIAS}), np.zeros((1, 3))), "both": (frozenset({DELAY, BIAS}), ACROSS)}
    assert collinear(search(**fits, **beside), whole, LAG) == frozenset(), "beside the others it does not"


def test_without_a_fit_without_the_cause_nothing_is_one_with_it() -> None:
    alone = search(best=(frozenset({LAG, BIAS}), DONE), other=(frozenset({DELAY, BIAS}), DONE))
    assert collinear(alone, frozenset({LAG, BIAS}), LAG) == frozenset()
