"""Runs that all begin in motion are diagnosed, without pictures, which need a start at rest."""

from __future__ import annotations

from station.diagnose.diagnose import diagnose
from station.model.effects import effect_class
from tests.estimation.made import AXIS, run_of


def test_friction_is_named_from_runs_none_of_which_begins_at_rest() -> None:
    torque = 0.02 * AXIS.motor.gain * AXIS.amplifier.limit
    rig = AXIS.with_effects([effect_class("coulomb_friction")(at="motor", torque=torque)])
    runs = [run_of(rig, size, "open", f"pulses {size:g}", 3.0).slice(150) for size in (60.0, 90.0, -70.0)]
    found = diagnose(AXIS, runs, effort="quick")
    assert [(c.effect, c.at) for c in found.diagnosis.causes] == [("coulomb_friction", "motor")]
    assert found.evidence == []
