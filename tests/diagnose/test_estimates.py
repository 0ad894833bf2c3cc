"""The rig that is handed back: values, and how surely they are known."""

from __future__ import annotations

import math
from typing import Any

import pytest

from station.diagnose.diagnose import diagnose
from station.diagnose.estimates import with_sizes
from station.diagnose.result import Estimate
from station.estimation.identifiability import NORMAL
from station.estimation.parameters import held_within
from station.model.effects import effect_class
from station.rig import Rig, load_rig
from tests.truth import RIGID_AXIS
from tests.truth.cases import make_case

AXIS = Rig.model_validate(RIGID_AXIS)


def size(value: float, low: float, high: float) -> Estimate:
    return Estimate(value=value, low=low, high=high, unit="", state="determined")


@pytest.mark.parametrize(("effect", "at", "sizes", "states"), [
    ("coulomb_friction", "motor", {"torque": size(0.02, 0.02 / 1.2, 0.02 * 1.2)}, {"torque": math.log(1.2) / NORMAL}),
    ("command_bias", "amplifier", {"offset": size(-20.0, -24.0, -16.0)}, {"offset": math.log(1.5) / 2.0 / NORMAL}),
    ("command_bias", "amplifier", {"offset": size(2.0, -1.0, 5.0)}, {"offset": 1.5 / NORMAL}),
    ("sublinear_drag", "motor", {"coefficient": size(0.1, 0.05, 0.2), "speed": size(math.inf, 3.0, math.inf)},
     {"coefficient": math.log(2.0) / NORMAL}),
    ("gravity_tilt", "base", {"torque": size(0.2, 0.1, 0.4), "angle": size(-0.3, -0.5, -0.1)},
     {"torque": math.log(2.0) / NORMAL, "angle": 0.2 / NORMAL}),
    ("gravity_tilt", "base", {"torque": size(0.2, 1e-9, 0.4), "angle": size(0.1, -math.pi, math.pi)},
     {"torque": math.pi, "angle": math.pi / NORMAL})])
def test_a_rig_states_how_surely_the_sizes_found_are_known(effect: str, at: str, sizes: dict[str, Estimate],
                                                           states: dict[str, float], tmp_path: Any) -> None:
    held = effect_class(effect)(at=at, **{name: one.value for name, one in sizes.items()})
    rig = with_sizes(AXIS.with_effects([held]), {(effect, at): sizes})
    found = {name: rig.uncertainty[f"{effect}.{name}"] for name in states}
    assert found == pytest.approx(states)
    assert set(rig.uncertainty) - set(AXIS.uncertainty) == {f"{effect}.{name}" for name in states}
    (tmp_path / "saved.toml").write_text(rig.to_toml())
    assert {one.name for one in held_within(load_rig(tmp_path / "saved.toml"))} == set(states)


def test_of_one_effect_at_two_places_the_larger_is_stated() -> None:
    arm = load_rig("sflr")
    rubbing = arm.with_effects([effect_class("coulomb_friction")(at=at, torque=0.02) for at in ("motor", "base")])
    sizes = {("coulomb_friction", at): {"torque": size(0.02, 0.02 / times, 0.02 * times)}
             for at, times in (("motor", 1.5), ("base", 1.1))}
    assert with_sizes(rubbing, sizes).uncertainty["coulomb_friction.torque"] == pytest.approx(math.log(1.5) / NORMAL)
    assert with_sizes(arm, sizes).uncertainty == arm.uncertainty


def test_what_is_found_today_is_where_tomorrows_runs_begin() -> None:
    """Other runs of one rig: of that which was handed back nothing is missing, and what it holds is not taken for
    exact."""
    case = make_case(65003, [("coulomb_friction", "motor")], nominal=RIGID_AXIS, count=6, band=(3000.0, 1e6),
                     disturbance=0.02, sized_in_world=True)
    first = diagnose(AXIS, case.runs[:3], effort="quick")
    assert [c.effect for c in first.diagnosis.causes] == ["coulomb_friction"]
    rig = first.extended_rig
    assert 0.0 < rig.uncertainty["coulomb_friction.torque"] < 0.3
    later = diagnose(rig, case.runs[3:], effort="quick")
    assert later.diagnosis.causes == [] and later.amiss == []
