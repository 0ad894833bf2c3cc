"""Screening on runs of the independent generator: what could be added to a fit, and what could stand in its place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from station.diagnose import screening
from station.diagnose.candidates import Candidate, candidates
from station.diagnose.rung import begun
from station.diagnose.screening import Screened, screen
from station.estimation.cause import Key
from station.estimation.constants import base_fit, unknown
from station.estimation.fitted import Fit, weighing_of
from station.estimation.least_squares import fit
from station.estimation.parameters import Hypothesis, parameters
from station.estimation.prediction import Predictor
from station.rig import Rig
from tests.estimation.made import predictions
from tests.truth import RIGID_AXIS, TWO_MASS, make_case

FRICTION, DEAD_ZONE = ("coulomb_friction", "motor"), ("dead_zone", "amplifier")
CURVE, TILT = ("gain_curve", "amplifier"), ("gravity_tilt", "base")


def hiding(table: dict, seed: int, hidden: Sequence[Key]) -> Predictor:
    """Predictions of runs of a rig that hides something."""
    runs = make_case(seed, list(hidden), nominal=table, count=4, band=(400.0, 1e5)).runs
    return predictions(Rig.model_validate(table), runs)


def fitted(predictor: Predictor, pool: Sequence[Candidate], causes: Sequence[Key]) -> Fit:
    """A set of causes, begun at usual sizes, under the weighing that its own errors give."""
    chosen = [next(c for c in pool if c.key == key) for key in causes]
    space = parameters(predictor.data, Hypothesis(tuple((c.effect, c.at) for c in chosen if c.effect)),
                       {c.key: c.guesses[0] for c in chosen})
    first = fit(predictor, space, unknown(predictor), space.mean)
    return fit(predictor, space, weighing_of(predictor, first), first.x, first.own)


def exchanges(predictor: Predictor, causes: Sequence[Key]) -> tuple[Fit, dict[Key, list[Screened]]]:
    pool = candidates(predictor.data.rig)
    parent = fitted(predictor, pool, causes)
    return parent, screen(predictor, parent, [c for c in pool if c.key not in parent.key])[2]


def test_what_should_stand_in_a_causes_place_is_found_beside_the_other() -> None:
    """A dead zone was taken for a curve beside friction: a parent that has the curve need not lead to it."""
    predictor = hiding(RIGID_AXIS, 8361, [DEAD_ZONE, FRICTION])
    parent, found = exchanges(predictor, [CURVE, FRICTION])
    assert set(found) == {CURVE, FRICTION}
    assert found[CURVE][0].candidate.key == DEAD_ZONE
    assert all(one.candidate.key not in parent.key for others in found.values() for one in others)
    exchanged = begun(predictor, parent, found[CURVE][:1], CURVE)
    assert exchanged is not None and exchanged.key == {DEAD_ZONE, FRICTION}
    assert exchanged.objective < parent.objective - 10.0


def test_of_a_single_cause_the_same_law_elsewhere_alone_is_looked_at() -> None:
    """The others were looked at when nothing was in the set yet."""
    predictor = hiding(TWO_MASS, 8062, [FRICTION])
    _, found = exchanges(predictor, [FRICTION])
    assert set(found) == {FRICTION}
    assert [one.candidate.key for one in found[FRICTION]] == [("coulomb_friction", "base")]


@pytest.mark.parametrize("angle", [0.8, 2.4, -0.9, -2.3])
def test_an_angle_between_the_guesses_is_read_off_two_of_them(angle: float) -> None:
    """A sine of any phase is made of two."""
    hidden = {"effect": "gravity_tilt", "at": "base", "torque": 0.004, "angle": angle}
    runs = make_case(8064, [hidden], nominal=TWO_MASS, count=5).runs
    predictor = predictions(Rig.model_validate(TWO_MASS), runs)
    parent, pool = base_fit(predictor), candidates(predictor.data.rig)
    said, *_ = [one for one in screen(predictor, parent, pool)[0] if one.candidate.key == TILT]
    assert abs(math.remainder(said.guess["angle"] - angle, 2.0 * math.pi)) < 0.5
    assert said.gain > 10.0


def test_of_a_law_with_a_phase_two_guesses_stand_for_all_that_differ_in_nothing_else() -> None:
    for candidate in candidates(Rig.model_validate(TWO_MASS)):
        told = [{k: v for k, v in guess.items() if k != candidate.phase} for guess in candidate.guesses]
        for one, *other in candidate.components:
            assert one in candidate.guesses and len(other) == (candidate.phase is not None)
            if candidate.phase is not None:
                turned = other[0][candidate.phase] - one[candidate.phase]
                assert abs(math.remainder(turned - 0.5 * math.pi, 2.0 * math.pi)) < 1e-9
                assert {**other[0], candidate.phase: one[candidate.phase]} == one
        seen = [{k: v for k, v in one.items() if k != candidate.phase} for one, *_ in candidate.components]
        assert [one for k, one in enumerate(told) if one not in told[:k]] == seen


def test_sizes_of_pairs_are_multiples_of_the_guess_whatever_was_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guess that would show too plainly is looked at at a smaller size; a pair's sizes are still those of the guess.
    """
    sizes: dict[float, dict[Key, float]] = {}
    predictor = hiding(RIGID_AXIS, 8063, [FRICTION, DEAD_ZONE])
    parent, pool = base_fit(predictor), candidates(predictor.data.rig)
    for strong in (np.inf, 1.0):
        monkeypatch.setattr(screening, "STRONG", strong)
        pair = next(pair for pair in screen(predictor, parent, pool)[1]
                    if {one.candidate.key for one in pair} & {DEAD_ZONE} and any(map(rubs, pair)))
        sizes[strong] = {one.candidate.key: one.guess[next(iter(one.guess))] * one.size for one in pair}
    assert sizes[1.0].keys() == sizes[np.inf].keys()
    for key, small in sizes[1.0].items():
        assert 0.4 < small / sizes[np.inf][key] < 2.5


def rubs(one: Screened) -> bool:
    """Coulomb's friction, or Stribeck's, of which it is a case."""
    return one.candidate.key in (FRICTION, ("stribeck_friction", "motor"))
