"""Loops that hold a rig against a torque that comes and goes: what the loop does is no friction, however it is read.

Simulated by such a loop's commands alone a rig drifts away, unless something holds it.
"""

from __future__ import annotations

import pytest

from station.diagnose.diagnose import diagnose
from station.diagnose.result import Diagnosis
from station.rig import Rig
from tests.truth.held import Sensor, held_axis

SLOW, NOISY, FINE, QUICK = (Sensor(50.0, 4096.0, seconds=8.0), Sensor(500.0, 4096.0, noise=5.0),
                            Sensor(200.0, 2.0**24), Sensor(1000.0, 2.0**20, seconds=4.0))
"""An encoder read slowly, a potentiometer, and two finer encoders than any torque needs."""
FRICTION = 0.03


def said(seed: int, sensor: Sensor, friction: float = 0.0, limit: float = 255.0) -> Diagnosis:
    nominal, runs = held_axis(seed, sensor, friction, limit)
    return diagnose(Rig.model_validate(nominal), runs, effort="quick").diagnosis


@pytest.mark.parametrize(("seed", "sensor"), [
    pytest.param(4103, SLOW, marks=pytest.mark.long),
    pytest.param(4105, NOISY, marks=pytest.mark.long), (4105, FINE)])
def test_what_a_loop_holds_is_not_held_by_friction(seed: int, sensor: Sensor) -> None:
    found = said(seed, sensor)
    assert found.causes == [] and found.verdict == "unexplained"


@pytest.mark.parametrize("sensor", [SLOW, pytest.param(QUICK, marks=pytest.mark.long)])
def test_friction_that_is_there_is_named(sensor: Sensor) -> None:
    found = said(4201, sensor, FRICTION, limit=10.0)
    assert [(cause.effect, cause.at) for cause in found.causes] == [("coulomb_friction", "motor")]
    assert found.disturbance.extended < 0.3 * found.disturbance.refitted < 0.3


@pytest.mark.long
def test_friction_leads_by_a_finer_encoder_than_its_torque_needs() -> None:
    """Four runs of a torque that comes and goes may share some of it by chance: once in three a bias stands beside."""
    found = [said(seed, FINE, FRICTION, limit=10.0) for seed in (4201, 4202, 4203)]
    assert all((one.causes[0].effect, one.causes[0].at) == ("coulomb_friction", "motor") for one in found)
    assert sorted(cause.effect for one in found for cause in one.causes[1:]) in ([], ["command_bias"])
    assert all(one.disturbance.extended < 0.3 * one.disturbance.refitted < 0.3 for one in found)
