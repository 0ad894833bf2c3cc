"""A wrong size of an effect that the rig file holds is a cause as a wrong constant is."""

from __future__ import annotations

from typing import Any

import pytest

from station.diagnose.candidates import candidates
from station.diagnose.diagnose import diagnose
from station.diagnose.equivalences import exact_sizes
from station.model.effects import Effect, effect_class
from station.rig import Rig, load_rig
from station.view import wording
from tests.truth import RIGID_AXIS
from tests.truth.cases import make_case

AXIS = Rig.model_validate(RIGID_AXIS)


def holding(*effects: Effect, **uncertainty: float) -> Rig:
    """The axis with effects in its file, some sizes of them known within an uncertainty."""
    stated = {path.replace("__", "."): sigma for path, sigma in uncertainty.items()}
    return AXIS.with_effects(list(effects)).model_copy(update={"uncertainty": {**AXIS.uncertainty, **stated}})


def made(name: str, at: str, **sizes: float) -> Effect:
    return effect_class(name)(at=at, **sizes)


def test_a_size_is_a_cause_where_the_file_states_its_uncertainty_and_its_effect_stands_once() -> None:
    tilt, slip = made("gravity_tilt", "base", torque=0.2, angle=0.1), made("coulomb_friction", "motor", torque=0.02)
    rig = holding(tilt, slip, gravity_tilt__torque=0.05, gravity_tilt__angle=0.1)
    found = {c.constant for c in candidates(rig)}
    assert {"gravity_tilt.torque", "gravity_tilt.angle"} <= found and "coulomb_friction.torque" not in found
    both = load_rig("sflr").with_effects([made("coulomb_friction", at, torque=0.02) for at in ("motor", "base")])
    both = both.model_copy(update={"uncertainty": {**both.uncertainty, "coulomb_friction.torque": 0.1}})
    assert not any(c.constant and c.constant.startswith("coulomb") for c in candidates(both))
    assert (rig.stated("gravity_tilt.torque"), rig.stated("motor.gain")) == (0.2, AXIS.motor.gain)
    with pytest.raises(KeyError):
        rig.stated("cable_spring.stiffness")


@pytest.mark.parametrize(("cause", "name", "share"), [
    pytest.param(("coulomb_friction", "motor"), "torque", 0.5, marks=pytest.mark.long),
    (("gravity_tilt", "base"), "torque", 1.8)])
def test_a_wrong_size_is_named_with_its_value_and_nothing_else(cause: tuple[str, str], name: str, share: float,
                                                               tmp_path: Any) -> None:
    case = make_case(65011, [cause], nominal=RIGID_AXIS, count=4, band=(3000.0, 1e6), disturbance=0.02,
                     sized_in_world=True)
    (hidden,) = case.truth["causes"]
    sizes = {key: value for key, value in hidden.items() if key not in ("effect", "at")}
    held = made(*cause, **{**sizes, name: share * sizes[name]})
    path = f"{cause[0]}.{name}"
    rig = holding(held, **{f"{cause[0]}__{size}": 0.05 for size in sizes})
    result = diagnose(rig, case.runs, effort="quick")
    assert [c.effect for c in result.diagnosis.causes] == [f"parameter:{path}"], result.diagnosis.causes
    value = result.diagnosis.causes[0].parameters["value"]
    assert value.low <= sizes[name] <= value.high and value.unit == "N m"
    sentence = wording.verdict_sentence(result.diagnosis, rig)
    assert f"wrong {path.replace('.', ' ').replace('_', ' ')}" in sentence
    assert wording.number(held.values()[name]) in sentence and result.amiss == []
    assert result.evidence and path in result.evidence[0].title
    (tmp_path / "extended.toml").write_text(result.extended_rig.to_toml())
    assert load_rig(tmp_path / "extended.toml").effects[0].values()[name] == pytest.approx(value.value, rel=1e-4)


def test_that_a_size_is_taken_for_exact_is_told_where_constants_are_named() -> None:
    tilt = made("gravity_tilt", "base", torque=0.2, angle=0.1)
    constant, effect = ("parameter:motor.gain", ""), ("coulomb_friction", "motor")
    (sentence,) = exact_sizes(holding(tilt, gravity_tilt__angle=0.1), [constant, effect])
    assert "gravity_tilt.torque" in sentence and "gravity_tilt.angle" not in sentence and "[uncertainty]" in sentence
    assert exact_sizes(holding(tilt, gravity_tilt__angle=0.1), [effect]) == []
    assert exact_sizes(holding(tilt, gravity_tilt__angle=0.1, gravity_tilt__torque=0.1), [constant]) == []
    assert exact_sizes(AXIS, [constant]) == []
