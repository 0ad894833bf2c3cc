"""The fit of a rig's constants: from several starts, and readings that are counted once."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from station.estimation.constants import PRIOR_SHARE, base_fit, cooled, searched, settled, unknown
from station.estimation.dataset import by_content, dataset
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.model.effects import effect_class
from station.rig import load_rig
from tests.estimation.made import AXIS, predictions, run_of, runs_of
from tests.truth import make_case


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    true = AXIS.with_constants({"motor.damping": 1.1 * AXIS.motor.damping})
    return Predictor(dataset(AXIS, runs_of(true)), observers(AXIS, 0.0), Pool())


def test_a_horizon_that_is_looked_at_three_times_says_no_more_than_once(predictor: Predictor) -> None:
    alone = replace(predictor, observers=observers(AXIS, 0.0, (math.inf,)))
    thrice = replace(predictor, observers=3 * alone.observers)
    space = parameters(predictor.data, Hypothesis(), {})
    once, again = (fit(p, space, Weighing(p.counts, 1.0), space.mean) for p in (alone, thrice))
    assert cooled(alone, once).temperature == pytest.approx(1.0)
    assert cooled(thrice, again).temperature == pytest.approx(3.0, rel=0.01), "but for the runs' own prior"
    warm = replace(again, weighing=replace(again.weighing, temperature=5.0))
    assert cooled(thrice, warm).temperature == 5.0


def test_starts_from_the_prior_end_in_one_minimum_and_say_so(predictor: Predictor) -> None:
    space, told = parameters(predictor.data, Hypothesis(), {}, ("motor.inertia",)), []
    found, agreeing = searched(predictor, space, 3, 0, lambda text, share: told.append((text, share)))
    assert agreeing == 3 and [share for _, share in told] == pytest.approx([1 / 3, 2 / 3, 1.0])
    ratio = found.space.rig_at(found.x).motor
    assert ratio.gain / ratio.damping == pytest.approx(AXIS.motor.gain / (1.1 * AXIS.motor.damping), rel=2e-3)
    assert found.space.rig_at(found.x).motor.inertia == AXIS.motor.inertia


def test_no_run_has_a_gain_that_no_supply_makes() -> None:
    """One of its own stands in for the friction of a slow run as well as friction does; where it would have to be too
    large all runs are held alike, and friction is left to be found.  A supply that differs keeps what it has."""
    rubbing = AXIS.with_effects([effect_class("coulomb_friction")(at="motor", torque=15.0 * AXIS.motor.gain)])
    runs = [run_of(rubbing, size, loop, f"{size:g}", 3.0) for size, loop in (
        (15.0, "p2"), (300.0, "p2"), (200.0, "p2"), (-250.0, "p1"))]
    found = base_fit(predictions(AXIS, runs))
    assert found.weighing.may == (False, True) and np.abs(found.own[:, 2]).max() < 1e-3
    supplies = (0.14, -0.12, 0.1, -0.15)
    runs = [run_of(AXIS.with_constants({"motor.gain": AXIS.motor.gain * (1.0 + share)}), size, "p2", f"{size:g}")
            for share, size in zip(supplies, (60.0, -90.0, 120.0, 40.0), strict=True)]
    found = base_fit(predictions(AXIS, runs))
    assert found.weighing.may == (True, True)
    np.testing.assert_allclose(found.own[:, 2] - found.own[:, 2].mean(), supplies - np.mean(supplies), atol=0.02)


def test_fits_of_runs_held_alike_say_so_under_every_weighing(predictor: Predictor) -> None:
    space = parameters(predictor.data, Hypothesis(), {})
    alike = unknown(predictor, (False, True))
    free = unknown(predictor)
    assert alike.differ[0] < 1e-3 < free.differ[0] and alike.differ[1] == free.differ[1]
    found = settled(predictor, fit(predictor, space, alike, space.mean))
    assert found.weighing.may == (False, True) and found.weighing.differ[0] < 1e-3


@pytest.mark.long
def test_how_much_runs_differ_is_found_wherever_the_fit_begins() -> None:
    """Runs of a disturbed arm: begun with runs that may not differ, the fit takes what each has of its own for errors
    so large that freeing it a little seems to buy nothing."""
    case = make_case(930007, [("sublinear_drag", "motor")], count=None, band="subtle", disturbance=0.02,
                     sized_in_world=True)
    runs = by_content(case.runs)
    data = dataset(load_rig("sflr"), runs)
    predictor = Predictor(data, observers(data.rig, data.noise[0]), Pool())
    found = base_fit(predictor)
    space = found.space
    alike = Weighing(PRIOR_SHARE * predictor.counts, 1.0)
    shut, again = (settled(predictor, fit(predictor, space, begun, space.mean, tolerance=1.0))
                   for begun in (alike, unknown(predictor)))
    for other in (shut, again):
        assert other.weighing.differ[1] == pytest.approx(found.weighing.differ[1], rel=0.3)
        assert found.log_evidence(found.weighing) > other.log_evidence(found.weighing) - 1.0
    assert found.weighing.differ[1] > 0.1
