"""A constant that the rig file calls exact stays where it is, and is no cause."""

from __future__ import annotations

import pytest

from station.diagnose.candidates import candidates
from station.diagnose.diagnose import diagnose
from tests.estimation.made import AXIS, runs_of

EXACT = AXIS.model_copy(update={"uncertainty": {**AXIS.uncertainty, "motor.inertia": 0.0}})


def test_it_is_no_candidate() -> None:
    assert "motor.inertia" in {c.constant for c in candidates(AXIS)}
    assert "motor.inertia" not in {c.constant for c in candidates(EXACT)}


def test_runs_are_diagnosed_and_it_has_not_moved() -> None:
    result = diagnose(EXACT, runs_of(AXIS), effort="quick")
    assert not result.diagnosis.causes
    assert result.constants["motor.inertia"].value == pytest.approx(AXIS.motor.inertia, rel=1e-5)
