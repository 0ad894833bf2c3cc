"""What runs have of their own in what the motor does: told from what all of them share, and sized."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from station.estimation.dataset import dataset
from station.estimation.fitted import Fit, weighing_of
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing, differ_ends
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.estimation.spread import differences
from station.model.effects import effect_class
from station.rig import Rig
from tests.estimation.made import AXIS, run_of

BIAS = effect_class("command_bias")
KEY = ("command_bias", "amplifier")
TESTS = [(90.0, "p2"), (-60.0, "p1"), (60.0, "open"), (-80.0, "p2"), (70.0, "p1"), (-50.0, "open")]
OFFSETS = np.array([-1.2, 1.6, -0.6, 1.0, 1.4, -1.8])
"""Counts of command; their mean is next to none."""
SHARES = np.array([0.025, -0.02, 0.015, -0.025, 0.02, -0.01])
VARIES = 5.41


def predicting(offsets: Sequence[float], shares: Sequence[float], rig: Rig = AXIS) -> Predictor:
    """Six runs of the axis, each with a bias and a motor gain of its own, as a rig predicts them."""
    runs = []
    for k, ((amplitude, controller), offset, share) in enumerate(zip(TESTS, offsets, shares, strict=True)):
        true = AXIS.with_constants({"motor.gain": AXIS.motor.gain * (1.0 + share)})
        runs.append(run_of(true.with_effects([BIAS(at="amplifier", offset=offset)]), amplitude, controller, f"run {k}"))
    return Predictor(dataset(rig, runs), observers(rig, 0.0), Pool())


def fitted(offsets: Sequence[float], shares: Sequence[float], effects: tuple = (), rig: Rig = AXIS,
           begun: tuple[float, float] | None = None) -> Fit:
    """The axis fitted to six such runs; how much they differ is estimated.

    ``begun``: fitted with differences of that size, once, and not again with the estimate.
    """
    predictor = predicting(offsets, shares, rig)
    weighing = Weighing(predictor.counts, 1.0, begun or (0.0, 0.0))
    space = parameters(predictor.data, Hypothesis(effects), {KEY: {"offset": 1.0}})
    found = fit(predictor, space, weighing, space.mean.copy())
    if begun:
        return replace(found, weighing=weighing_of(predictor, found))
    for _ in range(3):
        found = fit(predictor, space, weighing_of(predictor, found), found.x, found.own)
    return found


@pytest.fixture(scope="module")
def varied() -> Fit:
    return fitted(OFFSETS, SHARES)


def drawn(found: Fit) -> np.ndarray:
    """(20, stretches) weights of the Bayesian bootstrap."""
    return np.random.default_rng(5).exponential(size=(20, len(found.owner)))


def test_sizes_and_each_runs_own_are_found(varied: Fit) -> None:
    share, constant = differences(varied, varied.weighing, drawn(varied))
    assert constant.size == pytest.approx(np.sqrt(np.mean(OFFSETS**2)), rel=0.3)
    assert share.size == pytest.approx(np.sqrt(np.mean(SHARES**2)), rel=0.4)
    for seen in (share, constant):
        assert seen.gained > VARIES and np.all(2.0 * seen.log_odds > VARIES)
    np.testing.assert_allclose(varied.own[:, 3], OFFSETS, atol=0.5)
    assert np.corrcoef(varied.own[:, 2], SHARES)[0, 1] > 0.95


def test_runs_that_are_alike_do_not_differ() -> None:
    found = fitted(np.zeros(6), np.zeros(6))
    for seen in differences(found, found.weighing, drawn(found)):
        assert seen.gained < VARIES and np.mean(2.0 * seen.log_odds > VARIES) < 0.1
    assert np.abs(found.own[:, 2]).max() < 0.003 and np.abs(found.own[:, 3]).max() < 0.1


def test_a_bias_of_all_runs_is_a_cause_and_one_of_either_sign_is_none() -> None:
    """Each set by how much its runs most likely differ: what all share earns a parameter, what none share does not."""
    def gained(offsets: np.ndarray) -> float:
        with_bias = fitted(offsets, np.zeros(6), ((BIAS, "amplifier"),))
        without = fitted(offsets, np.zeros(6))
        one, other = (f.log_evidence(replace(with_bias.weighing, differ=f.most_likely_differ(with_bias.weighing)))
                      for f in (with_bias, without))
        return one - other
    assert gained(np.full(6, 3.0)) > 10.0
    assert gained(OFFSETS) < 2.0


@pytest.mark.parametrize("offsets", [OFFSETS, np.zeros(6), np.full(6, 3.0)])
def test_sizes_are_the_most_likely_ones(offsets: np.ndarray) -> None:
    """No other pair of sizes on a grid is more likely, down to runs that are quite alike."""
    found = fitted(offsets, np.zeros(6))
    best = found.log_evidence(replace(found.weighing, differ=found.most_likely_differ(found.weighing)))
    for share in (1e-6, 1e-4, 1e-3, 1e-2, 0.1):
        for constant in (1e-6, 1e-3, 1e-2, 0.1, 1.0, 2.0):
            assert found.log_evidence(replace(found.weighing, differ=(share, constant))) < best + 0.05


def test_what_runs_say_of_sizes_is_what_the_evidence_says(varied: Fit) -> None:
    """All else integrated out beforehand, or anew for every pair of sizes; and its slope is the slope."""
    sizes = np.array([(share, constant) for share in (1e-4, 1e-3, 0.02, 0.3) for constant in (0.01, 0.1, 1.5, 4.0)])
    seen = varied._differing(varied.weighing)
    more = seen.log_likelihoods(sizes) - varied.log_evidences(varied.weighing, sizes)
    np.testing.assert_allclose(more, more[0], atol=1e-6)
    at, h = np.log([0.015, 1.1]), 1e-4
    slope = [(seen.surprise(at + h * way)[0] - seen.surprise(at - h * way)[0]) / (2.0 * h) for way in np.eye(2)]
    np.testing.assert_allclose(seen.surprise(at)[1], slope, rtol=1e-4)


@pytest.mark.parametrize(("share", "sigma"), [(0.25, 0.02), (0.2, 0.02), (0.25, 0.03)])
def test_sizes_are_those_of_the_highest_of_two_modes(share: float, sigma: float) -> None:
    """A gain that is off in all runs alike, begun from runs that differ: they are alike and the gain is off, or they
    differ, by as much.  Which is likelier hangs on the gain's uncertainty; between lies what is unlikely."""
    certain = AXIS.model_copy(update={"uncertainty": {"default": 0.001, "motor.gain": sigma}})
    largest = differ_ends(certain)[1]
    found = fitted(np.zeros(6), np.full(6, share), rig=certain, begun=(largest[0], largest[1]))
    size, constant = found.most_likely_differ(found.weighing)
    best = found.log_evidence(replace(found.weighing, differ=(size, constant)))
    along = [found.log_evidence(replace(found.weighing, differ=(one, constant))) for one in np.geomspace(1e-6, 0.3, 40)]
    assert min(along[10:-1]) < min(along[0], along[-1]) - 1.0, "the case has two modes"
    assert max(along) < best + 0.05


def test_what_a_fit_to_runs_held_alike_comes_to_is_foreseen(varied: Fit) -> None:
    """By linear predictions and the likelihood's own cost; the quadratic alone is off by as much as is lost."""
    alike = replace(varied.weighing, differ=varied.most_likely_differ(replace(varied.weighing, may=(False, False))))
    ended = fit(predicting(OFFSETS, SHARES), varied.space, alike, varied.x)
    lost = varied.log_evidence(varied.weighing) - ended.log_evidence(alike)
    assert lost > 50.0
    assert varied.log_expected(alike) == pytest.approx(ended.log_evidence(alike), abs=0.2 * lost)
    assert abs(varied.log_evidence(alike) - ended.log_evidence(alike)) > 0.5 * lost
    assert varied.log_expected(varied.weighing) == pytest.approx(varied.log_evidence(varied.weighing), abs=0.1)


def test_without_a_step_left_to_take_the_evidence_is_that_of_the_fit(varied: Fit) -> None:
    """The quadratic about a fit at its optimum promises nothing more; a prior far from it costs what it says."""
    tight = replace(varied.weighing, differ=(1e-6, varied.weighing.differ[1]))
    assert varied.log_evidence(varied.weighing) > varied.log_evidence(tight) + 0.5 * VARIES
    wide = replace(varied.weighing, differ=(30.0 * varied.weighing.differ[0], varied.weighing.differ[1]))
    assert varied.log_evidence(varied.weighing) - varied.log_evidence(wide) == pytest.approx(
        6.0 * np.log(30.0) - 3.0, rel=0.3)


def test_sizes_that_runs_single_out_were_one_of_many_and_those_of_runs_alike_are_most() -> None:
    """The evidence averaged over an even distribution of each size's logarithm, over the largest."""
    for offsets, shares in ((OFFSETS, SHARES), (np.zeros(6), np.zeros(6))):
        found = fitted(offsets, shares)
        weighing = replace(found.weighing, differ=found.most_likely_differ(found.weighing))
        most, expected = found.log_evidence(weighing), 0.0
        for k, end in enumerate((0.3, 0.01 * AXIS.amplifier.limit)):
            logs = np.linspace(np.log(1e-6), np.log(end), 200)
            sizes = [tuple(np.where(np.arange(2) == k, np.exp(log), weighing.differ).tolist()) for log in logs]
            expected += np.log(np.mean([np.exp(found.log_evidence(replace(weighing, differ=(one, other))) - most)
                                        for one, other in sizes]))
        narrowed = float(found.log_narrowing(weighing).sum())
        assert narrowed == pytest.approx(expected, abs=0.1)
        assert narrowed < -3.0 if np.any(offsets) else narrowed > -1.5
