"""A parameter that differs from run to run is told from one that does not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import norm

from station.estimation.dataset import dataset
from station.estimation.fitted import Fit
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.estimation.spread import Spread, between_runs, shared
from station.model.effects import effect_class
from tests.estimation.made import AXIS, run_of

BIAS, FRICTION = effect_class("command_bias"), effect_class("coulomb_friction")
TESTS = [(90.0, "p2"), (-60.0, "p1"), (60.0, "open"), (-80.0, "p2"), (70.0, "p1"), (-50.0, "open")]
USUAL = 0.02 * AXIS.motor.gain * AXIS.amplifier.limit
VARIES = 5.41


def fitted(offsets: Sequence[float], torques: Sequence[float]) -> Fit:
    """A bias and friction fitted to six runs, each of which had its own."""
    runs = [run_of(AXIS.with_effects([BIAS(at="amplifier", offset=offset), FRICTION(at="motor", torque=torque)]),
                   amplitude, controller, f"run {k}")
            for k, ((amplitude, controller), offset, torque) in enumerate(zip(TESTS, offsets, torques, strict=True))]
    predictor = Predictor(dataset(AXIS, runs), observers(AXIS, 0.0), Pool())
    weighing = Weighing(predictor.counts, 1.0)
    space = parameters(predictor.data, Hypothesis(((BIAS, "amplifier"), (FRICTION, "motor"))),
                       {("command_bias", "amplifier"): {"offset": 3.0},
                        ("coulomb_friction", "motor"): {"torque": USUAL}})
    return fit(predictor, space, weighing, space.mean.copy(), tolerance=0.01, iterations=40)


def spreads(found: Fit) -> tuple[Spread, Spread, float]:
    """Of the bias, in counts, and of the friction, as a share; the bias that one value for all gives."""
    first = found.space.parts["effects"].start
    own = np.eye(found.space.size)
    scale = found.space.coordinates[0].scale
    bias = between_runs(found, own[first] / scale)
    return bias, between_runs(found, own[first + 1]), found.space.values(found.x)["command_bias", "amplifier"]["offset"]


def test_one_value_for_all_runs_shows_no_spread() -> None:
    bias, friction, common = spreads(fitted([3.0] * 6, [USUAL] * 6))
    assert bias.gained < VARIES and friction.gained < VARIES
    assert common == pytest.approx(3.0, abs=0.5)


def test_a_bias_that_differs_shows_its_size_and_friction_that_does_not_shows_none() -> None:
    offsets = np.array([-3.0, 5.0, 1.0, 7.0, -1.0, 4.0])
    bias, friction, _ = spreads(fitted(offsets, [USUAL] * 6))
    assert bias.gained > 10.0 * VARIES
    assert bias.size == pytest.approx(offsets.std(ddof=1), rel=0.5)
    assert friction.gained < bias.gained / 3.0


def test_a_shared_value_is_known_no_better_than_the_runs_agree_in_it() -> None:
    offsets = np.array([-3.0, 5.0, 1.0, 7.0, -1.0, 4.0])
    tight, wide = (found.space.coordinates[0].scale * np.sqrt(spreads(found)[0].covariance[k, k])
                   for found in (fitted(each, [USUAL] * 6) for each in ([3.0] * 6, offsets))
                   for k in (found.space.parts["effects"].start,))
    assert wide > 3.0 * tight
    assert wide == pytest.approx(offsets.std(ddof=1) / np.sqrt(6.0), rel=0.5)


def test_friction_that_differs_shows_as_a_share_of_its_size() -> None:
    shares = np.array([0.6, 1.4, 0.8, 1.3, 1.0, 1.1])
    _, friction, _ = spreads(fitted([3.0] * 6, list(USUAL * shares)))
    assert friction.gained > VARIES
    assert friction.size == pytest.approx(shares.std(ddof=1), rel=0.6)


def test_what_runs_share_is_more_likely_by_a_mean_of_its_own() -> None:
    """The ratio of two normal likelihoods, each with its own most likely spread."""
    values = np.array([-0.75, -0.8, -0.77, -0.76, -0.78])

    def log_likelihood(mean: float) -> float:
        spread = float(np.sqrt(np.mean((values - mean) ** 2)))
        return float(norm.logpdf(values, mean, spread).sum())
    assert shared(values) == pytest.approx(2.0 * (log_likelihood(values.mean()) - log_likelihood(0.0)))
    assert shared(values - values.mean()) == pytest.approx(0.0) and shared(np.ones(3)) == np.inf
