"""What is left of a fit's errors: noise passes for noise, however many rows were logged, and structure does not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from station.diagnose.remainder import Remainder, ahead_is_noise, misses_more_ahead, remainder
from station.diagnose.thresholds import NOISE
from station.estimation.constants import unknown
from station.estimation.fitted import Fit
from station.estimation.least_squares import fit
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.prediction import Predictor
from station.model.effects import effect_class
from tests.estimation.made import AXIS, predictions, run_of

ROWS = 5000
LOGGED = {"all": np.ones(ROWS), "every other": (np.arange(ROWS) % 2 == 0).astype(float),
          "with gaps": (np.random.default_rng(4).random(ROWS) < 0.7).astype(float)}


def left(errors: np.ndarray, logged: np.ndarray, sigma: float = 1.0) -> Remainder:
    """Of one run whose encoder is read at some rows; errors (n) in units of the noise, ``sigma`` counts."""
    data = SimpleNamespace(channels=1, records=[SimpleNamespace(share=logged[None])], noise_freedoms=(1e6, 1.0),
                           accel_noise=np.ones((2, 1)), sigma=np.array([sigma]))
    predictor = SimpleNamespace(data=data, longest=np.ones(1, dtype=bool))
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


def test_an_encoder_may_scatter_by_what_a_rest_in_the_middle_of_a_count_hides_but_not_slowly() -> None:
    """At rest it showed rounding alone, as it would by 0.2 counts of noise; by that its errors are half as large again.
    """
    rng, rounding = np.random.default_rng(6), 12.0**-0.5
    for more, noise in ((1.5, True), (1.9, True), (3.0, False)):
        errors = more**0.5 * rng.standard_normal(ROWS)
        assert left(errors, LOGGED["all"], rounding).is_noise == noise
        assert not left(errors, LOGGED["all"]).is_noise
    swing = 0.5 * np.sin(np.linspace(0.0, 40.0, ROWS))
    assert not left(1.5**0.5 * rng.standard_normal(ROWS) + swing, LOGGED["all"], rounding).is_noise


@pytest.mark.parametrize(("variance", "noise"), [(1.0, False), (4.0, True), (16.0, True)])
def test_an_accelerometers_errors_are_held_against_the_noise_of_their_own_run(variance: float, noise: bool) -> None:
    """Of twice the noise of all runs; the encoder's are as large as rounding makes them."""
    share, errors = np.ones((2, ROWS)), np.random.default_rng(5).standard_normal((2, ROWS)) * [[1.0], [2.0]]
    data = SimpleNamespace(channels=2, records=[SimpleNamespace(share=share)], noise_freedoms=(1e6, 1e6),
                           accel_noise=np.array([[variance], [1e6]]), sigma=np.ones(2))
    found = remainder(SimpleNamespace(data=data, longest=np.ones(2, dtype=bool)), SimpleNamespace(residuals=[errors]))
    assert found.is_noise == noise and abs(found.size[0, 0]) < NOISE


@cache
def fitted(hidden: str) -> tuple[Predictor, dict[str, Fit]]:
    """Of an axis with a coarse encoder, the rig alone and with the delay that acts, or with none that acts."""
    late = AXIS.with_effects([effect_class("input_delay")(at="amplifier", time=0.012)] if hidden else [])
    noisy = np.random.default_rng(7)
    runs = [replace(run, encoder=np.round(run.encoder + 0.4 * noisy.standard_normal(len(run))))
            for run in (run_of(late, 60.0, "open", name, 6.0) for name in ("one", "two"))]
    predictor = predictions(AXIS, runs)
    space = parameters(predictor.data, Hypothesis(), {})
    alone = fit(predictor, space, unknown(predictor), space.mean)
    with_delay = parameters(predictor.data, Hypothesis(((effect_class("input_delay"), "amplifier"),)),
                            {("input_delay", "amplifier"): {"time": 0.01}})
    best = fit(predictor, with_delay, alone.weighing, with_delay.carried(space, alone.x))
    return predictor, {"alone": alone, "best": best}


@pytest.mark.parametrize(("hidden", "found", "noise"), [
    ("", "alone", True), ("", "best", True), ("input_delay", "best", False), ("input_delay", "alone", False)])
def test_ahead_is_noise_only_where_no_cause_takes_something_away(hidden: str, found: str, noise: bool) -> None:
    """What takes all but noise away has that for its evidence: it must not be thrown away with it."""
    predictor, fits = fitted(hidden)
    assert ahead_is_noise(predictor, fits[found], fits["alone"]) is noise


@pytest.mark.parametrize("hidden", ["", "input_delay"])
def test_what_misses_more_ahead_than_noise_makes_is_seen(hidden: str) -> None:
    predictor, fits = fitted(hidden)
    assert misses_more_ahead(predictor, fits["alone"], fits["best"]) is bool(hidden)
    assert not misses_more_ahead(predictor, fits["best"], fits["alone"])
    assert not misses_more_ahead(predictor, fits["best"], fits["best"])
    space = fits["alone"].space
    far = space.mean.copy()
    far[space.paths.index("motor.gain")] += 3.0
    stopped = fit(predictor, space, fits["alone"].weighing, far, iterations=0)
    assert misses_more_ahead(predictor, stopped, fits["alone"])
