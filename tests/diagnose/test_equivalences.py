"""Known equivalences: both sides of each do the same on the model, there are no others, and they force the verdict."""

import math
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from station.diagnose.candidates import ACCEL, ENCODER, INPUT, one_too_many
from station.diagnose.equivalences import (
    CLOCK,
    GAIN,
    TABLE,
    Setting,
    completed,
    rescaled,
    rivals,
    standing,
    with_word,
)
from station.diagnose.odds import Odds
from station.diagnose.result import NextExperiment
from station.diagnose.thresholds import BELIEVABLE, LOG_PRIOR
from station.model.effects import effect_class
from station.model.simulate import build, simulate_model
from station.model.units import UnknownUnitError, dimension, powers
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.truth import CONTROLLERS, RIGID_AXIS, TWO_MASS

ROOT = Path(__file__).resolve().parents[2]
SFLR = load_rig("sflr")
AXIS, TWO = Rig.model_validate(RIGID_AXIS), Rig.model_validate(TWO_MASS)
NO_DRIVE = SFLR.model_copy(update={"drive": None, "base": SFLR.base.model_copy(update={"inertia": 0.003})})
SAME, SOLVED, SEEN = 1e-6, 1e-5, 0.02
"""Counts: equal; equal to what the stepper solves smooth torque laws to (its TOLERANCE), whose rounds change with the
unit of time; and plainly different."""


def make_run(reference: np.ndarray, controller: str, row: int = -1) -> Run:
    zero = np.zeros(len(reference))
    return Run(controller, np.arange(len(zero)) / 500.0, reference, reference, zero, zero,
               RunMetadata(controller=CONTROLLERS[controller], command_row=row))


def noise(rows: int, size: int = 200) -> np.ndarray:
    """A command that excites everything: whole counts at random, held for random times."""
    rng = np.random.default_rng(5)
    return np.repeat(rng.integers(-size, size + 1, rows), rng.integers(1, 12, rows))[:rows].astype(float)


STEP = np.where(np.arange(500) < 50, 0.0, 120.0)
RUNS = [make_run(noise(500), "open", 0), make_run(STEP, "p2"), make_run(-STEP, "lead")]


def effects(*rows: tuple[str, str, dict[str, float]]):
    return [effect_class(name)(at=at, **values) for name, at, values in rows]


def outputs(rig: Rig) -> np.ndarray:
    """Both channels of all runs, not rounded, in one row (counts)."""
    model = build(rig, truncation=0.0)
    found = [simulate_model(model, run, rounding=False, start_angle=0.01) for run in RUNS]
    return np.concatenate([c for s in found for c in (s.encoder, s.accel) if c is not None])


def setting(rig: Rig, clock: bool = False) -> Setting:
    return Setting(rig, clock, (0.01,))


def parameter(path: str) -> tuple[str, str]:
    return f"parameter:{path}", ""


def off(rig: Rig, **factors: float) -> Rig:
    """``motor__gain=1.5``: that constant times 1.5."""
    values = rig.constants()
    return rig.with_constants({k.replace("__", "."): values[k.replace("__", ".")] * f for k, f in factors.items()})


NONLINEAR = effects(("coulomb_friction", "motor", {"torque": 0.05}), ("stribeck_friction", "motor", {
    "static_torque": 0.03, "coulomb_torque": 0.02, "stribeck_velocity": 0.3}),
    ("sublinear_drag", "motor", {"coefficient": 0.05, "speed": 2.0}), ("quadratic_drag", "base", {"coefficient": 0.01}),
    ("backlash", "drive", {"gap": 0.02}), ("hardening_spring", "clamp", {"cubic": 30.0}),
    ("actuator_lag", "amplifier", {"time_constant": 0.004}),
    ("accelerometer_centripetal", "accelerometer", {"fraction": 0.3}),
    ("accelerometer_highpass", "accelerometer", {"time_constant": 0.4}),
    ("accelerometer_lag", "accelerometer", {"time_constant": 0.003}),
    ("accelerometer_saturation", "accelerometer", {"limit": 60.0}), ("dead_zone", "amplifier", {"width": 4.0}),
    ("encoder_eccentricity", "encoder", {"amplitude": 3.0, "phase": 0.4}))
FRICTION = effects(("coulomb_friction", "motor", {"torque": 0.05}))
TILT = effects(("gravity_tilt", "base", {"torque": 0.05, "angle": 0.7}))


def late(**times: float):
    places = {"input": INPUT, "encoder": ENCODER, "accelerometer": ACCEL}
    return effects(*((*places[name], {"time": time}) for name, time in times.items()))


def scaled_clock(ratio: float):
    return effects((*CLOCK, {"ratio": ratio}))


UNSURE = AXIS.model_copy(update={"uncertainty": {"default": 0.1, "motor.damping": 1.5}})
SURE = AXIS.model_copy(update={"uncertainty": {"default": 0.005}})
CASES = {
    "input late": ("delays", SFLR, SFLR, FRICTION, late(input=0.003), {frozenset({ENCODER, ACCEL})}),
    "input late, all nonlinear": ("delays", SFLR, SFLR, NONLINEAR, late(input=0.003), {frozenset({ENCODER, ACCEL})}),
    "both sensors late": ("delays", SFLR, SFLR, FRICTION, late(encoder=0.003, accelerometer=0.003),
                          {frozenset({INPUT})}),
    "sensors unlike late": ("delays", SFLR, SFLR, FRICTION, late(encoder=0.0045, accelerometer=0.003),
                            {frozenset({INPUT, ENCODER})}),
    "input and encoder": ("delays", SFLR, SFLR, FRICTION, late(input=0.003, encoder=0.0015),
                          {frozenset({ENCODER, ACCEL})}),
    "input and accelerometer": ("delays", SFLR, SFLR, FRICTION, late(input=0.003, accelerometer=0.0015),
                                {frozenset({ENCODER, ACCEL})}),
    "axis, input late": ("delays", AXIS, AXIS, FRICTION, late(input=0.003), {frozenset({ENCODER})}),
    "axis, encoder late": ("delays", AXIS, AXIS, FRICTION, late(encoder=0.003), {frozenset({INPUT})}),
    "clock": ("unit of time", SFLR, SFLR, NONLINEAR, scaled_clock(0.97), None),
    "gain": ("unit of torque", SFLR, off(SFLR, motor__gain=1.6), NONLINEAR, [], None),
    "axis, gain": ("unit of torque", AXIS, off(AXIS, motor__gain=1.6), FRICTION, [],
                   {frozenset({parameter("motor.inertia"), parameter("motor.damping")})}),
    "axis, all but the gain": ("unit of torque", AXIS, off(AXIS, motor__inertia=2.0, motor__damping=2.0), FRICTION, [],
                               {frozenset({GAIN})}),
    "axis, hardly known damping": ("unit of torque", UNSURE, off(UNSURE, motor__inertia=2.5), FRICTION, [],
                                   {frozenset({GAIN})}),
    "light stiff beam": ("unit of length", SFLR,
                         off(SFLR, beam__mass_per_length=0.125, tip__mass=0.25, accelerometer__gain=0.5,
                             beam__flexural_rigidity=2.0), NONLINEAR, [],
                         {frozenset({parameter("beam.length")})}),
    "clock as constants": ("unit of time", SURE, off(SURE, motor__inertia=0.9216, motor__damping=0.96), [], [],
                           {frozenset({CLOCK})}),
    "inertia on one shaft": ("one shaft", NO_DRIVE, off(NO_DRIVE, motor__inertia=3.0), FRICTION, [],
                             {frozenset({parameter("base.inertia")})}),
    "tilt on one shaft": ("tilt or ripple", NO_DRIVE, NO_DRIVE, FRICTION, TILT,
                          {frozenset({("torque_ripple", "motor")})}),
}
"""Name of the equivalence, nominal rig, the rig as it is, effects beside, effects named, the other sides' causes."""


def sides_of(name: str):
    equivalence, nominal, rig, beside, named, expected = CASES[name]
    nominal = nominal.with_effects(beside)
    whole = rig.with_effects([*beside, *named])
    constants = {parameter(p) for p, v in rig.constants().items() if abs(v / nominal.constants()[p] - 1.0) > 1e-9}
    causes = frozenset({(e.name, e.at) for e in named} | constants)
    found = standing(setting(nominal), causes, whole)
    return equivalence, causes, whole, found, expected


@pytest.mark.parametrize("name", CASES)
def test_both_sides_do_the_same_on_the_model(name):
    equivalence, causes, whole, found, expected = sides_of(name)
    sides = [side for row in found if row.equivalence.name == equivalence for side in row.sides]
    assert sides
    if expected is not None:
        assert expected <= {side.causes for side in sides}
    said = outputs(whole)
    for side in sides:
        assert not side.causes >= causes
        assert side.rig != whole
        assert np.max(np.abs(outputs(side.rig) - said)) < (SOLVED if name == "clock" else SAME)


@pytest.mark.parametrize("name", ["input late", "both sensors late", "clock", "gain", "light stiff beam",
                                  "tilt on one shaft"])
def test_a_map_that_is_slightly_wrong_does_not_agree(name):
    """One number of the other side one percent off is seen, so the agreement above says something."""
    equivalence, causes, whole, found, _ = sides_of(name)
    side = next(side for row in found if row.equivalence.name == equivalence for side in row.sides)
    said = outputs(whole)
    for key in sorted(side.causes):
        if key[0].startswith("parameter:"):
            path = key[0].split(":")[1]
            wrong = side.rig.with_constants({path: 1.01 * side.rig.constants()[path]})
            if path in ("tip.inertia", "beam.damping", "clamp.damping"):
                continue  # these runs hardly see them
        else:
            wrong = side.rig.with_effects([
                e.model_copy(update={k: 1.01 * v for k, v in e.values().items()}) if (e.name, e.at) == key else e
                for e in side.rig.effects])
        assert np.max(np.abs(outputs(wrong) - said)) > SEEN, key


def test_a_slow_clock_agrees_to_the_accuracy_of_the_steps():
    """A longer period is cut into more steps, so friction and joints agree to the steps' error alone."""
    whole = SFLR.with_effects([*FRICTION, *scaled_clock(1.03)])
    found = standing(setting(SFLR.with_effects(FRICTION)), frozenset({CLOCK}), whole)
    assert np.max(np.abs(outputs(found[0].sides[0].rig) - outputs(whole))) < 0.2


@pytest.mark.parametrize("rig, known", [(SFLR, 2), (AXIS, 1), (TWO, 1), (NO_DRIVE, 3)],
                         ids=["sflr", "rigid axis", "two masses", "no drive"])
def test_the_units_and_the_one_shaft_are_all_that_cannot_be_seen(rig, known):
    """The constants' directions that change no output of rich runs are those of the table and no more."""
    paths, nominal, step = list(rig.constants()), rig.constants(), 3e-6

    def at(logs: np.ndarray) -> np.ndarray:
        return outputs(rig.with_constants({p: nominal[p] * math.exp(v) for p, v in zip(paths, logs, strict=True)}))
    jacobian = np.stack([(at(step * e) - at(-step * e)) / (2.0 * step) for e in np.eye(len(paths))], axis=1)
    directions = [d for d in (powers(paths, 0), powers(paths, 1)) if np.any(d)]
    if rig.drive is None and rig.base is not None:
        directions.append(np.array([{"motor.inertia": 1.0 / nominal[p], "base.inertia": -1.0 / nominal[p]}.get(p, 0.0)
                                    for p in paths]))
    basis = np.linalg.qr(np.array(directions).T)[0]
    assert basis.shape[1] == known
    assert np.linalg.norm(jacobian @ basis) < 1e-6 * np.linalg.norm(jacobian)
    rest = jacobian @ (np.eye(len(paths)) - basis @ basis.T)
    sizes = np.linalg.svd(rest, compute_uv=False)
    assert sizes[-known - 1] > 0.3 and sizes[-known] < 1e-3 * sizes[-known - 1]


@pytest.mark.parametrize("unit, wanted", [
    ("N m", (1, 0, 0)), ("kg m^2", (1, 0, 2)), ("kg/m", (1, -3, 2)), ("N m^2", (1, 1, 0)), ("counts s^2/m", (0, -1, 2)),
    ("N m s^2/rad^2", (1, 0, 2)), ("rad/s", (0, 0, -1)), ("N m/count", (1, 0, 0)), ("1/rev", (0, 0, 0))])
def test_a_units_dimension_is_read(unit, wanted):
    assert dimension(unit) == wanted


def test_a_unit_that_is_not_known_is_refused_and_every_effects_is_known():
    with pytest.raises(UnknownUnitError):
        dimension("N m/volt")
    for effect in NONLINEAR:
        for info in effect.parameters().values():
            dimension(info.unit)
    assert rescaled(SFLR, torque=2.0).motor.gain == pytest.approx(2.0 * SFLR.motor.gain)


def only(name: str, rig: Rig, named, beside=(), clock: bool = False) -> list[str]:
    """Names of the equivalences that stand where these effects are named."""
    whole = rig.with_effects([*beside, *named])
    causes = frozenset((e.name, e.at) for e in named)
    return [row.equivalence.name for row in standing(setting(rig.with_effects(beside), clock), causes, whole)]


def test_a_sensor_that_is_late_alone_has_no_other_side():
    assert only("delays", SFLR, late(encoder=0.003)) == []
    assert only("delays", SFLR, late(accelerometer=0.003)) == []


def test_a_torque_that_acts_by_itself_marks_time_zero():
    """With a tilt in a released run the input's delay does not delay its fall: the sides differ."""
    assert only("delays", SFLR, late(input=0.003), beside=TILT) == []
    one = outputs(SFLR.with_effects([*TILT, *late(input=0.006)]))
    other = outputs(SFLR.with_effects([*TILT, *late(encoder=0.006, accelerometer=0.006)]))
    assert np.max(np.abs(one - other)) > SEEN


def test_a_delay_that_the_rig_file_holds_cannot_be_traded():
    assert only("delays", SFLR, late(input=0.003), beside=late(encoder=0.001)) == []


def test_a_second_clock_decides():
    assert only("unit of time", SFLR, scaled_clock(1.03)) == ["unit of time"]
    assert only("unit of time", SFLR, scaled_clock(1.03), clock=True) == []


@pytest.mark.parametrize("effect", NONLINEAR, ids=lambda e: e.name)
def test_other_effects_are_one_side_of_nothing(effect):
    assert only("any", SFLR, [effect]) == []


@pytest.mark.parametrize("path", sorted(set(SFLR.constants()) - {"motor.gain"}))
@pytest.mark.parametrize("sigmas", [6.0, 20.0, -8.0])
def test_of_clear_constants_only_the_gain_is_forced(path, sigmas):
    """The others on the torque scale need all the rest to be off: no believable reading."""
    factor = math.exp(max(sigmas * SFLR.sigma(path), -3.0))
    rig = SFLR.with_constants({path: factor * SFLR.constants()[path]})
    for clock in (True, False):
        assert standing(setting(SFLR, clock), frozenset({parameter(path)}), rig) == []
    gain = off(SFLR, motor__gain=factor)
    assert [row.equivalence.name for row in standing(setting(SFLR, True), frozenset({GAIN}), gain)] == [
        "unit of torque"]


def test_the_others_on_the_scale_are_rivals_of_the_gain():
    _, causes, _, found, _ = sides_of("gain")
    paths = list(SFLR.constants())
    scale = {parameter(p) for p, power in zip(paths, powers(paths, 0), strict=True) if power}
    other, held = ("dead_zone", "amplifier"), ("coulomb_friction", "motor")
    odds = completed(Odds([(causes, 0.9), (frozenset({other}), 0.08), (frozenset({held}), 0.02)], {}, 0.0, {}), causes,
                     found)
    said = {(r.effect, r.at): r.probability for r in rivals(odds, causes, GAIN, found)}
    assert set(said) == scale - {GAIN} | {other, held} and said.pop(other) == pytest.approx(0.08)
    assert said.pop(held) == pytest.approx(0.02) and set(said.values()) == {BELIEVABLE}
    assert {(r.effect, r.at) for r in rivals(odds, causes, GAIN, [])} == {other, held}


@pytest.mark.parametrize("rig", [SFLR, AXIS, TWO], ids=["accelerometer", "axis", "two masses"])
def test_a_set_of_delays_is_one_too_many_just_where_fewer_do_the_same(rig):
    sites = {"input": INPUT, "encoder": ENCODER} | ({} if rig.accelerometer is None else {"accelerometer": ACCEL})
    for names in (names for count in range(len(sites) + 1) for names in combinations(sites, count)):
        times = {name: 0.001 * (k + 1) for k, name in enumerate(names)}
        causes = frozenset(sites[name] for name in names) | {("coulomb_friction", "motor")}
        rows = standing(setting(rig), causes, rig.with_effects([*FRICTION, *late(**times)]))
        fewer = [side for row in rows for side in row.sides if len(side.causes) < len(causes)]
        # Of two times alone that happen to be equal one is enough, too: no matter of the set.
        assert one_too_many(rig, causes) == (len(names) == len(sites)), names
        assert not one_too_many(rig, causes) or any(fewer), names


def test_odds_of_two_sides_stand_as_the_prior_says():
    pair, three = frozenset({INPUT, ENCODER}), frozenset({ENCODER, ACCEL})
    whole = SFLR.with_effects(late(input=0.003, encoder=0.0015))
    found = standing(setting(SFLR), pair, whole)
    odds = completed(Odds([(pair, 0.98), (frozenset(), 0.02)], {INPUT: 0.98, ENCODER: 0.98}, 0.02, {}), pair, found)
    assert odds.causes[INPUT] == pytest.approx(odds.causes[ACCEL])
    assert dict(odds.sets)[three] == pytest.approx(dict(odds.sets)[pair])
    assert sum(p for _, p in odds.sets) == pytest.approx(1.0)
    lone = frozenset({INPUT})
    found = standing(setting(SFLR), lone, SFLR.with_effects(late(input=0.003)))
    odds = completed(Odds([(lone, 0.98), (frozenset(), 0.02)], {INPUT: 0.98}, 0.02, {}), lone, found)
    side = 0.98 * math.exp(LOG_PRIOR)
    assert odds.causes[INPUT] == pytest.approx(0.98 / (1.0 + side))
    assert odds.causes[ACCEL] == pytest.approx(side / (1.0 + side))


def test_no_test_is_proposed_where_only_equivalents_are_left():
    named, other = frozenset({INPUT}), frozenset({("actuator_lag", "amplifier")})
    found = standing(setting(SFLR), named, SFLR.with_effects(late(input=0.003)))
    chosen = NextExperiment(test={"kind": "step"}, why="they differ here")
    sure, torn = (completed(Odds([(named, p), (other, 1.0 - p)], {INPUT: p}, 0.0, {}), named, found)
                  for p in (0.99, 0.6))
    said = with_word(chosen, "ambiguous", sure, named, found)
    assert said.test is None and found[0].equivalence.sentence in said.why and "hardware" in said.why
    for odds, verdict in ((torn, "ambiguous"), (sure, "partly_explained")):
        said = with_word(chosen, verdict, odds, named, found)
        assert said.test == chosen.test and chosen.why in said.why and found[0].equivalence.sentence in said.why
    assert with_word(chosen, "ambiguous", sure, named, []) is chosen
    assert with_word(None, "unexplained", sure, named, found) is None


def test_the_docs_hold_the_table_and_when_each_row_applies_and_its_proof():
    text = (ROOT / "docs" / "equivalences.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+) \| (.+) \| .{30,} \| (.+) \|$", text, re.M)
    assert rows == [(e.name, e.sentence, e.tells) for e in TABLE]
    assert re.findall(r"^\*\*(.+)\.\*\* .{80,}$", text, re.M) == [e.name for e in TABLE]
    assert len({e.name for e in TABLE}) == len(TABLE)
