"""Rig files: what is written reads back, and may be added to."""

from __future__ import annotations

import json

import pytest

from station.errors import UsageError
from station.rig import Rig, builtin_rigs, load_rig
from tests.truth import RIGID_AXIS, TWO_MASS

RIGS = {"sflr": load_rig("sflr"), "axis": Rig.model_validate(RIGID_AXIS), "two-mass": Rig.model_validate(TWO_MASS)}


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_was_written_reads_back_and_takes_effects_at_its_end(name):
    rig = RIGS[name]
    assert Rig.from_toml(rig.to_toml()) == rig
    more = Rig.from_toml(rig.to_toml() + '\n[[effects]]\neffect = "dead_zone"\nwidth = 3.0\n')
    assert [effect.name for effect in more.effects] == ["dead_zone"]
    assert Rig.from_toml(more.to_toml()) == more


def test_limits_are_optional_and_read_back():
    assert RIGS["sflr"].limits is None and "limits" not in RIGS["sflr"].to_toml()
    assert RIGS["sflr"].command_limit == 200.0
    rig = Rig.from_toml(RIGS["sflr"].to_toml() + "\n[limits]\ntravel = 2.5\ncommand = 120.0\n")
    assert (rig.limits.travel, rig.limits.speed, rig.limits.command, rig.command_limit) == (2.5, None, 120.0, 120.0)
    assert Rig.from_toml(rig.to_toml()) == rig


def test_a_mesh_is_as_fine_as_its_accuracy_wants_never_coarser_than_the_file_and_left_where_the_file_insists():
    rig = RIGS["sflr"]
    assert rig.meshed().beam.elements == 8 and rig.meshed().meshed() == rig.meshed()
    assert rig.with_elements(20).meshed().beam.elements == 20
    stated = Rig.from_toml(rig.to_toml().replace('"refined"', '"as_stated"'))
    assert stated.meshed().beam.elements == 4 and Rig.from_toml(stated.to_toml()) == stated
    fast = rig.model_copy(update={"sample_rate": 16.0 * rig.sample_rate})
    assert 29 <= fast.meshed().beam.elements <= 32       # four times the wave number
    assert RIGS["axis"].meshed() is RIGS["axis"]


def test_a_fit_that_strays_to_absurd_beams_does_not_refine_its_mesh_without_end():
    rig = RIGS["sflr"].meshed()
    length = rig.beam.length
    elements = [rig.with_constants({"beam.length": times * length}).remeshed().beam.elements for times in (1, 2, 4, 20)]
    assert elements == [8, 16, 32, 32]


@pytest.mark.parametrize(("line", "words"), [
    ("travel = -1.0", "limits.travel: .*greater than 0, not -1.0"), ("speed = 0.0", "limits.speed: .*greater than 0"),
    ("command = inf", "limits.command: "), ('travel = "far"', "limits.travel: "),
    ("jerk = 1.0", "limits.jerk: unknown")])
def test_a_limit_that_is_none_is_refused_with_the_keys_path(line, words):
    with pytest.raises(UsageError, match=f"mine.toml: {words}"):
        Rig.from_toml(RIGS["sflr"].to_toml() + f"\n[limits]\n{line}\n", "mine.toml")


EFFECT = '[[effects]]\neffect = "coulomb_friction"\nat = "motor"\ntorque = {}\n'


@pytest.mark.parametrize(("old", "new", "words"), [
    ("limit = 200.0", 'limit = "200"', "amplifier.limit: .*number without quotes, not '200'"),
    ("damping = 0.158669", "damping = true", "motor.damping: .*number, not True"),
    ("damping = 0.158669", "damping = 0.158669\nback_emf = 1.5", "motor.back_emf: .*less than or equal to 1, not 1.5"),
    ("damping = 0.158669", "damping = 0.158669\nback_emf = -0.1", "motor.back_emf: .*greater than or equal to 0"),
    ("elements = 4", "elements = 4.5", "beam.elements: .*integer, not 4.5"),
    ("[uncertainty]", EFFECT.format('"0.49"') + "[uncertainty]", r"effects: \[0\].torque: .* quotes, not '0.49'"),
    ("[uncertainty]", EFFECT.format("true") + "[uncertainty]", r"effects: \[0\].torque: .*number, not True"),
    ("[uncertainty]", '[[effects]]\neffect = ["x"]\n[uncertainty]', r"effects: \[0\].effect: the name of an effect"),
    ("[uncertainty]", EFFECT.format("1").replace("motor", "tip") + "[uncertainty]", r"effects: \[0\]: coulomb"),
])
def test_a_value_of_a_wrong_type_is_refused_not_read_as_a_number(old, new, words):
    with pytest.raises(UsageError, match=f"mine.toml: {words}"):
        Rig.from_toml(builtin_rigs()["sflr"].replace(old, new, 1), "mine.toml")


def test_whole_numbers_and_what_json_says_of_a_rig_are_taken():
    text = builtin_rigs()["sflr"].replace("limit = 200.0", "limit = 200") + "\n" + EFFECT.format(1)
    rig = Rig.from_toml(text)
    assert (rig.amplifier.limit, rig.effects[0].torque) == (200.0, 1.0)
    said = rig.model_dump_json()
    assert Rig.model_validate_json(said) == Rig.model_validate(json.loads(said)) == rig


@pytest.mark.parametrize(("text", "words"), [
    ("", "name, sample_rate, amplifier, motor, encoder: missing$"),
    (builtin_rigs()["sflr"].replace("stiffness = 0.102728", "stifness = 0.102728"),
     "drive.stifness: unknown key; drive.stiffness: missing$"),
    ("a = 1\nb = 1\nc = 1\n", "a, b, c: unknown key; name, sample_rate, amplifier: missing .and 2 more.$")])
def test_all_keys_that_are_wrong_are_named_as_far_as_a_line_goes(text, words):
    with pytest.raises(UsageError, match=f"mine.toml: {words}"):
        Rig.from_toml(text, "mine.toml")


@pytest.mark.parametrize(("values", "words"), [
    ({"tip.mas": 0.1}, "^tip.mas: rig sflr has no such constant; it has motor.inertia, "),
    ({"tip": 1}, "^tip: rig sflr has no such constant"), ({"beam.elements": 4.0}, "^beam.elements: "),
    ({"tip.mass": -1.0}, "^tip.mass: .*greater than or equal to 0, not -1.0"),
    ({"tip.mass": float("nan")}, "^tip.mass: .*not nan"), ({"motor.inertia": float("inf")}, "^motor.inertia: "),
    ({"motor.gain": 0.0}, "^motor.gain: a motor without gain cannot be driven"),
    ({"tip.mass": "heavy"}, "^tip.mass: a number is wanted, not 'heavy'")])
def test_a_constant_that_a_rig_file_could_not_have_is_refused_with_its_key(values, words):
    with pytest.raises(UsageError, match=words):
        RIGS["sflr"].with_constants(values)


def test_constants_of_a_part_that_is_left_out_and_what_is_no_effect_are_refused():
    with pytest.raises(UsageError, match="^tip.mass: rig .* has no such constant; it has motor.inertia"):
        RIGS["axis"].with_constants({"tip.mass": 0.1})
    with pytest.raises(UsageError, match="^effects: 1 is no effect"):
        RIGS["sflr"].with_effects([1])


def test_constants_of_either_sign_and_none_at_all_are_taken_where_a_rig_file_takes_them():
    rig = RIGS["sflr"].with_constants({"motor.gain": -0.01, "drive.damping": 0.0, "tip.mass": 0.1})
    assert (rig.motor.gain, rig.drive.damping, rig.tip.mass) == (-0.01, 0.0, 0.1)
