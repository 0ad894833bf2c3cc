"""Odds over sets of causes."""

from __future__ import annotations

import math

import pytest

from station.diagnose.posterior import normalised

FRICTION, DEAD_ZONE = ("coulomb_friction", "motor"), ("dead_zone", "amplifier")


def test_a_cause_has_the_probability_of_all_sets_that_hold_it() -> None:
    odds = normalised({frozenset(): 0.0, frozenset({FRICTION}): math.log(2.0),
                       frozenset({FRICTION, DEAD_ZONE}): math.log(5.0)})
    assert odds.causes == {FRICTION: pytest.approx(7 / 8), DEAD_ZONE: pytest.approx(5 / 8)}
    assert odds.nothing == pytest.approx(1 / 8)
    assert odds.sets[0][0] == frozenset({FRICTION, DEAD_ZONE})


@pytest.mark.parametrize(("explained", "trust"), [(1.0, 0.5), (0.6, 0.3), (-0.2, 0.0)])
def test_what_nothing_explains_makes_what_is_named_and_its_rivals_less_sure(explained: float, trust: float) -> None:
    odds = normalised({frozenset(): 0.0, frozenset({FRICTION}): 0.0, frozenset({DEAD_ZONE}): math.log(2.0)})
    doubted = odds.doubted(explained)
    assert doubted.causes == {FRICTION: pytest.approx(0.25 * trust), DEAD_ZONE: pytest.approx(0.5 * trust)}
    assert doubted.replacements(frozenset({DEAD_ZONE}), DEAD_ZONE) == {FRICTION: pytest.approx(0.25 * trust)}
    assert doubted.nothing == pytest.approx(0.25)
