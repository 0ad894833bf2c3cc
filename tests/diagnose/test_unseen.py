"""What is said of runs left out is exact where the model is linear; and a cause falls where runs speak against it."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from station.diagnose import heldout
from station.diagnose.estimate import Fit
from station.diagnose.problem import Hypothesis, Layout
from station.diagnose.unseen import refuted, surprise, unseen_gain
from station.model.effects import Stage

ROWS = 30
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


@pytest.mark.parametrize("size", [0.0, 20.0])
def test_a_gain_is_of_errors_on_runs_that_the_fits_have_not_seen(size):
    sizes = [size] * 5
    rng = np.random.default_rng(0)
    seen = np.array([HOW_WELL_SEEN @ (b * HOW_WELL_SEEN + rng.normal(size=ROWS)) for b in sizes])
    rng = np.random.default_rng(0)
    noise = np.array([rng.normal(size=ROWS) for _ in sizes])
    rest = np.sum((noise - np.outer(noise @ HOW_WELL_SEEN, HOW_WELL_SEEN)) ** 2)
    others = (seen.sum() - seen) / (len(seen) - 1 + 1.0 / SIZE**2)
    expected = 1.0 - np.sqrt((rest + np.sum((seen - others) ** 2)) / (rest + np.sum(seen**2)))
    gain = unseen_gain(without_each(sizes, False), without_each(sizes, True))
    assert gain == pytest.approx(expected, rel=1e-9)
    assert gain < 0.0 if size == 0.0 else gain > 0.5


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


def test_a_run_left_out_keeps_its_own_place_in_a_gap(monkeypatch):
    """The runs that remain say nothing of it; without it a true backlash simulates the run wrongly."""
    asked = []
    monkeypatch.setattr(heldout, "fit", lambda problem, layout, *given, weights, **how: asked.append((layout, weights)))
    layout = Layout(Hypothesis(), [], np.zeros((0, 0)), [], 0, 3, np.array([7.0, 0.0, 0.0, 0.0]), np.ones(4))
    found = SimpleNamespace(layout=layout, x=np.array([9.0, 0.1, -0.2, 0.3]), start=None, offset=None,
                            jacobian_at=lambda scale: None)
    problem = SimpleNamespace(runs=[None] * 3, scale=None, pool=SimpleNamespace(map=map))
    assert len(heldout.leave_each_out(problem, found)) == 3
    assert [list(weights) for _, weights in asked] == [[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]]
    assert [list(given.prior_mean) for given, _ in asked] == [
        [7.0, 0.1, 0.0, 0.0], [7.0, 0.0, -0.2, 0.0], [7.0, 0.0, 0.0, 0.3]]
