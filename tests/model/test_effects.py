"""Every effect of the catalogue, at every place: neutral where it should be, and the law that an independent
generator (tests.truth) has too, on the same beam so that only the effect can differ; wrong sizes are told apart."""

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from numba import cfunc
from pydantic import ValidationError

from station.control.references import reference_from_test
from station.diagnose.equivalences import rescaled
from station.model import stepper
from station.model.assembly import assemble
from station.model.compiled import LAW, njit
from station.model.effects import USUAL_SPEED, Effect, Stage, catalogue, effect_class
from station.model.effects.base import PICTURES, parameter
from station.model.simulate import Model, Simulation, build, initial_state, simulate, simulate_model
from station.model.units import dimension
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.truth import (
    CATALOGUE,
    CONTROLLERS,
    RIGID_AXIS,
    SERVO,
    SFLR,
    TWO_MASS,
    Conditions,
    draw_servo_tests,
    effect_names,
    pulse_test,
    simulate_case,
    step_test,
)
from tests.truth.simulate import Output, Truth

VALUES = {
    ("accelerometer_centripetal", "accelerometer"): {"fraction": 0.4},
    ("accelerometer_delay", "accelerometer"): {"time": 0.0033},
    ("accelerometer_highpass", "accelerometer"): {"time_constant": 0.2},
    ("accelerometer_lag", "accelerometer"): {"time_constant": 0.004},
    ("accelerometer_saturation", "accelerometer"): {"limit": 25.0},
    ("actuator_lag", "amplifier"): {"time_constant": 0.006},
    ("actuator_saturation", "amplifier"): {"limit": 90.0},
    ("backlash", "drive"): {"gap": 0.04},
    ("cable_spring", "base"): {"stiffness": 0.15, "rest": 0.3},
    ("clock_scale", "clock"): {"ratio": 1.03},
    ("command_bias", "amplifier"): {"offset": 5.0},
    ("coulomb_friction", "motor"): {"torque": 0.05},
    ("coulomb_friction", "base"): {"torque": 0.05},
    ("dead_zone", "amplifier"): {"width": 6.0},
    ("encoder_delay", "encoder"): {"time": 0.0047},
    ("encoder_eccentricity", "encoder"): {"amplitude": 4.0, "phase": 1.0},
    ("gain_asymmetry", "amplifier"): {"ratio": 1.2},
    ("gain_curve", "amplifier"): {"exponent": 0.2},
    ("gravity_tilt", "base"): {"torque": 0.05, "angle": 1.0},
    ("hardening_spring", "drive"): {"cubic": 1.5},
    ("hardening_spring", "clamp"): {"cubic": 300.0},
    ("input_delay", "amplifier"): {"time": 0.0047},
    ("load_friction", "drive"): {"fraction": 0.3},
    ("load_friction", "motor"): {"fraction": 0.3},
    ("quadratic_drag", "base"): {"coefficient": 0.02},
    ("stribeck_friction", "motor"): {"static_torque": 0.1, "coulomb_torque": 0.05, "stribeck_velocity": 0.4},
    ("sublinear_drag", "motor"): {"coefficient": 0.1, "speed": 0.7},
    ("torque_ripple", "motor"): {"amplitude": 0.06, "cycles": 6.0, "phase": 1.0},
}
"""A plain size of each effect on the flexible arm, or on one without a drive."""
EVERYWHERE = [(name, at) for name, cls in catalogue().items() for at in cls.sites
              if cls.__module__.startswith("station.model.effects")]
KEYS = [(name, at) for name, at in EVERYWHERE if effect_class(name).fits(load_rig("sflr"), at)]
"""On the flexible arm, which has a drive."""
ROUGH = {("backlash", "drive"): (0.01, 0.07)}
TOLERANCE, FINE = (0.01, 0.045), (0.004, 0.02)
"""Largest difference (encoder, accelerometer counts) at the usual step, and at one of 0.1 ms."""
STEP = 1e-5
"""Of the generator, s: its dry friction is of first order in the step."""
SEEN = 10.0
"""A wrong effect differs by more than this many tolerances."""
OPPOSING = {("cable_spring", "stiffness"), ("quadratic_drag", "coefficient"), ("sublinear_drag", "coefficient"),
            ("coulomb_friction", "torque"), ("load_friction", "fraction"), ("gravity_tilt", "torque"),
            ("torque_ripple", "amplitude"), ("encoder_eccentricity", "amplitude")}
"""Parameters whose bounds allow one sign, which the law gives a direction."""
SIGNED = {"accelerometer_centripetal", "cable_spring", "command_bias", "coulomb_friction", "encoder_eccentricity",
          "gain_curve", "gravity_tilt", "hardening_spring", "load_friction", "quadratic_drag", "stribeck_friction",
          "sublinear_drag", "torque_ripple"}
"""Effects that push to one side, or against the motion."""
UNITS = {"1", "1/rev", "s", "rad", "rad/s", "counts", "N m", "N m/rad", "N m/rad^3", "N m s/rad", "N m s^2/rad^2"}

RATE, ZERO, START, OFFSET = 500.0, 0.3, 0.1, 2.0
TESTS = [step_test(RATE, "lead_accel", 150.0, 1.2), pulse_test(RATE, 120.0, 0.1, duration=1.2),
         step_test(RATE, "p2", 60.0, 1.2)]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("sflr")


def truths(effects: list[dict]) -> list[Output]:
    """The three tests by the independent generator, with the model's own number of beam elements, unrounded."""
    truth = Truth(SFLR, effects, elements=4, modes=9, step=STEP)
    return [truth.run(test.reference, CONTROLLERS[test.controller], start_angle=START + ZERO, zero_angle=ZERO,
                      accel_offset=OFFSET, accel_zero=OFFSET, rounding=False) for test in TESTS]


def as_run(test, start: str = "released") -> Run:
    controller = CONTROLLERS[test.controller]
    zero = np.zeros(len(test.reference))
    meta = RunMetadata(controller=controller, command_row=0 if controller["kind"] == "open" else -1,
                       accel_zero=OFFSET, start=start)
    return Run(test.name, np.arange(len(zero)) / RATE, test.reference, test.reference, zero, zero, meta)


def differences(rig: Rig, outputs: list[Output], longest: float = 5e-4) -> np.ndarray:
    """Largest difference over the tests: encoder, accelerometer, counts; infinite where the model diverges."""
    model, found = build(rig, longest=longest), np.zeros(2)
    for test, output in zip(TESTS, outputs, strict=True):
        made = simulate_model(model, as_run(test), rounding=False, start_angle=START, zero=ZERO, accel_offset=OFFSET)
        both = [np.max(np.abs(made.encoder - output.encoder)), np.max(np.abs(made.accel - output.accel))]
        found = np.maximum(found, np.nan_to_num(both, nan=np.inf, posinf=np.inf))
    return found


def wrong_versions(cls: type[Effect], at: str, values: dict[str, float]):
    """(what was done, effect): doubled, phase turned by pi, sign flipped; a ratio's distance from 1 doubled."""
    def made(name: str, value: float) -> Effect:
        return cls.model_construct(at=at, **(values | {name: value}))

    for name, info in cls.parameters().items():
        value = values[name]
        if info.periodic:
            yield f"{name} turned", made(name, value - math.copysign(math.pi, value))
            continue
        yield f"{name} doubled", made(name, value**2 if name == "ratio" else 2.0 * value)
        if info.low < 0.0 or (cls.name, name) in OPPOSING:
            yield f"{name} flipped", made(name, -value)
    if cls.name == "stribeck_friction":
        levels = {name: -values[name] for name in ("static_torque", "coulomb_torque")}
        yield "levels flipped", cls.model_construct(at=at, **(values | levels))


def test_every_effect_has_a_case_here_and_in_the_independent_generator():
    assert set(VALUES) == set(EVERYWHERE) == set(CATALOGUE)
    assert set(EVERYWHERE) - set(KEYS) == {("load_friction", "motor")}


@pytest.mark.parametrize("key", KEYS, ids="@".join)
def test_effect_agrees_with_the_independent_generator_and_a_wrong_one_does_not(rig, key):
    name, at = key
    cls, values = effect_class(name), VALUES[key]
    outputs = truths([{"effect": name, "at": at, **values}])
    right = rig.with_effects([cls(at=at, **values)])
    allowed = np.array(ROUGH.get(key, TOLERANCE))
    assert np.all(differences(right, outputs) <= allowed)
    assert np.all(differences(right, outputs, longest=1e-4) <= FINE)
    assert np.any(differences(rig, outputs) > SEEN * allowed), "off"
    for what, effect in wrong_versions(cls, at, values):
        assert np.any(differences(rig.with_effects([effect]), outputs) > SEEN * allowed), what


@pytest.mark.parametrize("key", [key for key in KEYS if effect_class(key[0]).law is not None], ids="@".join)
def test_a_law_with_the_wrong_sign_or_five_percent_too_much_is_noticed(rig, key, monkeypatch):
    name, at = key
    cls, values = effect_class(name), VALUES[key]
    right, outputs = njit(cls.law), truths([{"effect": name, "at": at, **values}])

    def negated(x, v, w, p, s, h):
        return -right(x, v, w, p, s, h)

    def larger(x, v, w, p, s, h):
        return 1.05 * right(x, v, w, p, s, h)

    def address(law) -> int:
        compiled.append(cfunc(LAW, error_model="numpy")(law))   # without the cache on disk
        return compiled[-1].address

    compiled: list = []
    monkeypatch.setattr("station.model.simulate.address", address)
    for law in (negated, larger):
        monkeypatch.setattr(cls, "law", staticmethod(law))
        wrong = differences(rig.with_effects([cls(at=at, **values)]), outputs)
        assert np.any(wrong > ROUGH.get(key, TOLERANCE)), law.__name__


def test_every_kind_of_wrong_is_tried():
    """Turned where periodic, flipped where a sign has meaning; delays, lags, gaps, widths, limits, ratios doubled."""
    tried = {(name, at): {what for what, _ in wrong_versions(effect_class(name), at, VALUES[name, at])}
             for name, at in KEYS}
    assert {name for (name, _), wrongs in tried.items() if any("flipped" in what for what in wrongs)} == SIGNED
    for (name, at), wrongs in tried.items():
        for parameter_name, info in effect_class(name).parameters().items():
            how = "turned" if info.periodic else "doubled"
            assert f"{parameter_name} {how}" in wrongs, (name, at)
    assert {name for name, _ in KEYS if any("turned" in what for what in tried[name, effect_class(name).sites[0]])} == {
        "encoder_eccentricity", "gravity_tilt", "torque_ripple"}


RIGS = {table["name"]: Rig.model_validate(table) for table in (SFLR, TWO_MASS, RIGID_AXIS)}
RIGS |= {f"sflr without {part}": RIGS["sflr"].model_copy(update={part: None})
         for part in ("drive", "clamp", "accelerometer")}


@pytest.mark.parametrize("name", sorted({name for name, _ in KEYS}))
def test_an_effect_is_whole(name):
    """Units, bounds, a neutral value, sizes to start from on every rig that it fits, a picture, a test that tells."""
    cls = effect_class(name)
    infos = cls.parameters()
    assert cls.title and cls.__doc__ and cls.picture in PICTURES and isinstance(cls.stage, Stage)
    assert any(info.neutral is not None and info.low <= info.neutral <= info.high for info in infos.values())
    for parameter_name, info in infos.items():
        assert info.unit in UNITS and info.low < info.high
        for beyond in (info.low - 1.0, info.high + 1.0):
            if math.isfinite(beyond):
                with pytest.raises(ValidationError):
                    cls(at=cls.sites[0], **(VALUES[name, cls.sites[0]] | {parameter_name: beyond}))
    for rig_name, shape in RIGS.items():
        for at in cls.sites:
            assert cls.fits(shape, at) == ((name, at) in effect_names(tables()[rig_name])), rig_name
            if cls.fits(shape, at):
                guesses = [cls(at=at, **guess) for guess in cls.guesses(shape, at)]
                assert guesses and all(neutral(cls, guess.values()) != guess.values() for guess in guesses)
    if name == "clock_scale":   # host times tell it, no test does
        assert cls.experiment == {} and "host times" in cls.telling
        return
    test = {key: value for key, value in cls.experiment.items() if key != "controller"}
    assert np.ptp(reference_from_test(test, RATE)) > 0.0
    rivals = {other.title for other in catalogue().values() if other is not cls} | set(RIGS["sflr"].constants())
    assert any(rival in cls.telling for rival in rivals), cls.telling


def tables() -> dict[str, dict]:
    """The generator's own tables of RIGS."""
    found = {table["name"]: table for table in (SFLR, TWO_MASS, RIGID_AXIS)}
    return found | {f"sflr without {part}": {key: value for key, value in SFLR.items() if key != part}
                    for part in ("drive", "clamp", "accelerometer")}


def neutral(cls: type[Effect], values: dict[str, float]) -> dict[str, float]:
    found = {name: values[name] if info.neutral is None else info.neutral for name, info in cls.parameters().items()}
    assert found != values, f"{cls.name} has no neutral value"
    return found


@pytest.mark.parametrize("key", KEYS, ids="@".join)
def test_neutral_value_gives_the_linear_model_back(rig, key):
    name, at = key
    cls = effect_class(name)
    effect = cls(at=at, **neutral(cls, VALUES[key]))
    plain, with_it = build(rig, truncation=0.0), build(rig.with_effects([effect]), truncation=0.0)
    for test in TESTS:
        one, other = (simulate_model(model, as_run(test), rounding=False, start_angle=START, accel_offset=OFFSET)
                      for model in (plain, with_it))
        for channel in ("encoder", "accel"):
            whole = getattr(one, channel)
            np.testing.assert_allclose(getattr(other, channel), whole, rtol=0.0, atol=1e-9 * np.abs(whole).max())


@pytest.mark.parametrize("key", KEYS, ids="@".join)
def test_what_acts_at_ticks_alone_takes_one_step_a_period_and_is_the_same_in_many(rig, key):
    name, at = key
    cls = effect_class(name)
    effect = cls(at=at, **VALUES[key])
    within = effect_class("coulomb_friction")(at="motor", torque=0.0)
    once, often = (build(rig.with_effects(effects), truncation=0.0) for effects in ([effect], [effect, within]))
    at_ticks = cls.states == 0 and cls.stage in (Stage.COMMAND, Stage.ENCODER, Stage.ACCEL_INPUT, Stage.ACCEL_COUNTS,
                                                 Stage.INPUT_DELAY, Stage.CLOCK)
    assert often.plan.substeps > 1 and (once.plan.substeps == 1) == at_ticks
    for test in TESTS if at_ticks else ():
        one, many = (simulate_model(model, as_run(test), rounding=False, start_angle=START, accel_offset=OFFSET)
                     for model in (once, often))
        for channel in ("encoder", "accel"):
            whole = getattr(one, channel)
            np.testing.assert_allclose(getattr(many, channel), whole, rtol=0.0, atol=1e-8 * np.abs(whole).max())


@pytest.mark.parametrize("shape", sorted(set(RIGS) - {"sflr"}))
def test_every_effect_agrees_with_the_independent_generator_on_a_rig_of_other_parts(shape):
    rig, table, tests = RIGS[shape], tables()[shape], [test for test in TESTS if test.controller != "lead_accel"]
    for name, at in effect_names(table):
        values = VALUES[name, at]
        truth = Truth(table, [{"effect": name, "at": at, **values}], elements=4, modes=9, step=STEP)
        model = build(rig.with_effects([effect_class(name)(at=at, **values)]), longest=1e-4)
        for test in tests:
            output = truth.run(test.reference, CONTROLLERS[test.controller], start_angle=START, rounding=False)
            made = simulate_model(model, as_run(test), rounding=False, start_angle=START)
            gaps = [np.max(np.abs(made.encoder - output.encoder))]
            assert (made.accel is None) == (output.accel is None) == (rig.accelerometer is None)
            gaps += [] if output.accel is None else [np.max(np.abs(made.accel - output.accel))]
            assert np.all(gaps <= np.array(TOLERANCE[: len(gaps)])), (name, at, test.name, gaps)


PENDULUM = {"effect": "gravity_tilt", "at": "base", "torque": 0.6, "angle": 0.2}
RIPPLE = {"effect": "torque_ripple", "at": "motor", "amplitude": 0.1, "cycles": 6.0, "phase": 1.0}
LATE = [{"effect": "input_delay", "at": "amplifier", "time": 0.0047},
        {"effect": "actuator_lag", "at": "amplifier", "time_constant": 0.006}]


@pytest.mark.parametrize("others", [[PENDULUM], [RIPPLE], [*LATE[:1], PENDULUM], [*LATE, RIPPLE]],
                         ids=["pendulum", "ripple", "late pendulum", "lagging ripple"])
@pytest.mark.parametrize("missing", [("drive", "base", "clamp", "beam", "tip", "accelerometer"), ("drive",),
                                     ("drive", "clamp")], ids=["axis", "arm", "arm without clamp"])
def test_load_friction_without_a_drive_agrees_with_the_independent_generator_and_a_wrong_one_does_not(missing, others):
    """Torques of motor and load, a beam's included, on the side where they are; a wrong side is far off."""
    table = {key: value for key, value in SFLR.items() if key not in (*missing, "uncertainty")}
    if "beam" in missing:
        table = RIGID_AXIS
    table = table | {"motor": table["motor"] | {"back_emf": 0.4}}
    cls, test = effect_class("load_friction"), step_test(RATE, "p2", 60.0, 1.2)
    truth = Truth(table, [*others, {"effect": "load_friction", "at": "motor", "fraction": 0.3}], elements=4, modes=9,
                  step=STEP)
    output = truth.run(test.reference, CONTROLLERS["p2"], start_angle=START, rounding=False)

    def difference(right: list[Effect], back_emf: float = 0.4) -> np.ndarray:
        held = [effect_class(e["effect"])(**{k: v for k, v in e.items() if k != "effect"}) for e in others]
        rig = Rig.model_validate(table).with_constants({"motor.back_emf": back_emf}).with_effects(held + right)
        made = simulate_model(build(rig, longest=1e-4), as_run(test), rounding=False, start_angle=START)
        gaps = [np.max(np.abs(made.encoder - output.encoder))]
        return np.array(gaps + ([] if output.accel is None else [np.max(np.abs(made.accel - output.accel))]))

    assert np.all(difference([cls(at="motor", fraction=0.3)]) <= TOLERANCE[: 1 if "beam" in missing else 2])
    for wrong in ([], [cls.model_construct(at="motor", fraction=-0.3)], [cls(at="motor", fraction=0.33)]):
        assert difference(wrong)[0] > SEEN * TOLERANCE[0], wrong
    assert difference([cls(at="motor", fraction=0.3)], 0.9)[0] > SEEN * TOLERANCE[0]


def test_load_friction_stands_at_the_drive_or_where_there_is_none_at_the_motor():
    cls = effect_class("load_friction")
    for shape in RIGS.values():
        assert cls.fits(shape, "drive") == (shape.drive is not None) != cls.fits(shape, "motor")
    with pytest.raises(ValidationError, match="load_friction at motor"):
        Rig.model_validate(SFLR | {"effects": [{"effect": "load_friction", "at": "motor", "fraction": 0.2}]})


def plain_pendulum(command: np.ndarray, fraction: float, gravity: float, step: float,
                   external: float = 1.0, back_emf: float = 1.0) -> np.ndarray:
    """Angles (n), rad, of the rigid axis as a pendulum with friction of fraction |motor torque - external torque|.

    Written out by hand from Duclusaud et al., semi-implicit Euler: friction is what stops the axis within the step,
    clipped at its level.  ``external``: share of gravity that counts as load, ``back_emf``: of the damping.
    """
    inertia, damping, gain = (RIGID_AXIS["motor"][key] for key in ("inertia", "damping", "gain"))
    angle, speed, rows, each = 0.0, 0.0, [], round(1.0 / (RATE * step))
    for count in command:
        rows.append(angle)
        for _ in range(each):
            motor, pull = gain * count - damping * speed, -gravity * math.sin(angle)
            level = fraction * abs(motor + (1.0 - back_emf) * damping * speed - external * pull)
            friction = min(max(-(inertia / step * speed + motor + pull), -level), level)
            speed += step / inertia * (motor + pull + friction)
            angle += step * speed
    return np.array(rows)


@pytest.mark.parametrize("back_emf", [None, 1.0, 0.35, 0.0])
def test_load_friction_on_an_axis_agrees_with_a_plain_integration(back_emf):
    """Of first order in its step, so that its error halves; with the load taken otherwise it is far off."""
    command = np.concatenate([np.full(200, 90.0), np.full(150, -40.0), np.zeros(150), np.full(500, 45.0)])
    zero = np.zeros(command.size)
    run = Run("pendulum", np.arange(command.size) / RATE, command, command, zero, zero, RunMetadata())
    table = RIGID_AXIS | {"motor": RIGID_AXIS["motor"] | ({} if back_emf is None else {"back_emf": back_emf})}
    share = 1.0 if back_emf is None else back_emf
    rig = Rig.model_validate(table).with_effects(
        [effect_class("gravity_tilt")(at="base", torque=0.6, angle=0.0), effect_class("load_friction")(
            at="motor", fraction=0.3)])
    angle = simulate_model(build(rig, longest=5e-5), run, rounding=False).encoder * rig.angle_per_count
    coarse, fine = (np.abs(plain_pendulum(command, 0.3, 0.6, step, back_emf=share) - angle).max()
                    for step in (4e-5, 2e-5))
    assert 0.45 * coarse < fine < 0.55 * coarse and fine < 1e-4
    for fraction, external, other in ((0.3, 0.0, share), (0.3, -1.0, share), (0.0, 1.0, share), (-0.3, 1.0, share),
                                      (0.31, 1.0, share), (0.3, 1.0, abs(share - 0.5))):
        wrong = plain_pendulum(command, fraction, 0.6, 4e-5, external, other)
        assert np.abs(wrong - angle).max() > 20.0 * coarse, (fraction, external, other)
    assert angle[-1] > 0.3 and np.ptp(angle[-100:]) < 1e-12, "a load that is shared with the motor is held"


EQUILIBRIA = [[{"effect": "cable_spring", "at": "base", "stiffness": 0.15, "rest": 0.3},
               {"effect": "coulomb_friction", "at": "motor", "torque": 0.08}],
              [{"effect": "command_bias", "at": "amplifier", "offset": 4.0},
               {"effect": "coulomb_friction", "at": "motor", "torque": 0.08},
               {"effect": "actuator_lag", "at": "amplifier", "time_constant": 0.006}],
              [{"effect": "gravity_tilt", "at": "base", "torque": 0.05, "angle": 1.0},
               {"effect": "stribeck_friction", "at": "motor", "static_torque": 0.1, "coulomb_torque": 0.05,
                "stribeck_velocity": 0.4}, {"effect": "input_delay", "at": "amplifier", "time": 0.0047}]]


@pytest.mark.parametrize("effects", EQUILIBRIA, ids=lambda rows: rows[0]["effect"])
def test_equilibrium_start_agrees_with_the_independent_generator(rig, effects):
    truth = Truth(SFLR, effects, elements=4, modes=9, step=STEP)
    built = [effect_class(e["effect"])(**{k: v for k, v in e.items() if k != "effect"}) for e in effects]
    test = step_test(RATE, "p2", 60.0, 1.2)
    out = truth.run(test.reference, CONTROLLERS["p2"], start="equilibrium", start_angle=START, rounding=False)
    found = {start: simulate_model(build(rig.with_effects(built), longest=1e-4), as_run(test, start), rounding=False,
                                   start_angle=START) for start in ("equilibrium", "released")}
    gap = {start: np.abs(made.encoder - out.encoder).max() for start, made in found.items()}
    assert gap["equilibrium"] <= 0.01 and np.abs(found["equilibrium"].accel - out.accel).max() <= 0.05
    if effects[0]["effect"] != "command_bias":  # friction holds the bias from the first row of either start
        assert gap["released"] > 0.1


def test_pairs_of_effects_agree_with_the_independent_generator(rig):
    """Laws that share a port, the drive or the chain, together."""
    pairs = [(("backlash", "drive"), ("hardening_spring", "drive")), (("coulomb_friction", "motor"),
             ("load_friction", "drive")), (("dead_zone", "amplifier"), ("gain_asymmetry", "amplifier")),
             (("input_delay", "amplifier"), ("actuator_lag", "amplifier")), (("accelerometer_highpass",
             "accelerometer"), ("accelerometer_lag", "accelerometer")), (("encoder_delay", "encoder"),
             ("encoder_eccentricity", "encoder")), (("load_friction", "drive"), ("backlash", "drive")),
             (("clock_scale", "clock"), ("input_delay", "amplifier"))]
    for pair in pairs:
        outputs = truths([{"effect": name, "at": at, **VALUES[name, at]} for name, at in pair])
        effects = [effect_class(name)(at=at, **VALUES[name, at]) for name, at in pair]
        gaps = differences(rig.with_effects(effects), outputs)
        assert np.all(gaps <= (0.06, 0.2)), (pair, gaps)


def test_the_arms_four_elements_are_within_a_quarter_count_of_a_fine_beam(rig):
    outputs = simulate_case(SFLR, [], TESTS, [Conditions(start_angle=START + ZERO, zero_angle=ZERO,
                                                         accel_offset=OFFSET)] * len(TESTS), exact=True)
    encoder, accel = differences(rig, outputs)
    assert encoder <= 0.005 and 0.02 < accel <= 0.3


def friction(name: str, at: str) -> Effect:
    return effect_class(name)(at=at, **VALUES[name, at])


def motion(model: Model, command: np.ndarray) -> np.ndarray:
    """Angles and speeds (n, 2 coordinates) after each period of an open loop, from rest."""
    state, work, out, rows = initial_state(model), stepper.working_room(model.plan), np.zeros(2), []
    stepper.begin(model.plan, state)
    for count in command:
        stepper.tick(model.plan, state, float(count), 0.0, False, work, out)
        rows.append(model.form.basis @ state.z)
    return np.array(rows)


@pytest.mark.parametrize(("name", "at"), [("coulomb_friction", "motor"), ("coulomb_friction", "base"),
                                          ("stribeck_friction", "motor")])
def test_friction_holds_a_part_at_rest(rig, name, at):
    """Under a command below the level the speed is 0, not small, at every tick; at twice the level it is not.

    The angle may shift by less than 10^-6 rad while a load that builds up bends within the steps.
    """
    effect, parts = friction(name, at), assemble(rig)
    level = (effect.values().get("static_torque") or effect.values()["torque"]) / rig.motor.gain
    part = parts.motor if at == "motor" else parts.base
    held, loose = (motion(build(rig.with_effects([effect])), np.full(1500, share * level)) for share in (0.95, 2.0))
    assert np.abs(held[:, parts.size + part]).max() < 1e-13 and np.abs(held[:, part]).max() < 1e-6
    assert np.abs(loose[:, parts.size + part]).max() > 1e-2 and np.abs(loose[:, part]).max() > 1e-3


def test_load_friction_holds_a_motor_that_a_wound_drive_pushes(rig):
    """At rest the level is a share of the drive's torque, which alone can never beat it; motion comes to a stop."""
    command = np.concatenate([np.full(100, 80.0), np.zeros(1900)])
    run = Run("coast", np.arange(2000) / RATE, command, command, 0.0 * command, 0.0 * command, RunMetadata())
    free = rig.model_copy(update={"motor": rig.motor.model_copy(update={"damping": 0.02})})
    speeds = {}
    for effects in ([], [friction("load_friction", "drive")]):
        angle = simulate_model(build(free.with_effects(effects)), run, rounding=False, states=True).states[:, 0]
        speeds[len(effects)] = np.sum(np.abs(np.diff(angle[200:])))
    assert speeds[1] < 0.8 * speeds[0]


@pytest.mark.parametrize(("name", "at"), [("coulomb_friction", "motor"), ("coulomb_friction", "base"),
                                          ("stribeck_friction", "motor"), ("load_friction", "drive"),
                                          ("sublinear_drag", "motor"), ("quadratic_drag", "base")])
def test_friction_and_drag_only_take_energy(rig, name, at):
    """On an arm without any damping of its own, after a pulse, the energy never grows and does fall.

    The mean torque of a step in which the motion turns does work on the way of the whole step: of second order in it.
    """
    plain = rig.with_constants({"motor.damping": 0.0, "drive.damping": 0.0, "clamp.damping": 0.0, "beam.damping": 0.0})
    parts = assemble(plain)
    energies = {}
    for effects in ([], [friction(name, at)]):
        model = build(plain.with_effects(effects), truncation=0.0, longest=2.5e-4)
        x = motion(model, np.where(np.arange(900) < 20, 60.0, 0.0))[20:]
        q, v = x[:, : parts.size], x[:, parts.size:]
        energies[len(effects)] = 0.5 * np.sum(q @ parts.stiffness * q + v @ parts.mass * v, axis=1)
    np.testing.assert_allclose(energies[0], energies[0][0], rtol=1e-6)
    assert np.max(np.diff(energies[1])) <= 1e-8 * energies[1][0]
    assert energies[1][-1] < 0.7 * energies[1][0]


@pytest.mark.parametrize(("name", "at", "size"), [("backlash", "drive", "gap"), ("coulomb_friction", "motor", "torque"),
                                                   ("coulomb_friction", "base", "torque"),
                                                   ("stribeck_friction", "motor", "static_torque")])
def test_readings_move_smoothly_with_a_gap_and_with_friction(rig, name, at, size):
    """Contacts and stops fall between steps: a thousandth more must do what a thousandth less undoes."""
    def readings(share: float) -> np.ndarray:
        values = VALUES[name, at] | {size: share * VALUES[name, at][size]}
        model = build(rig.with_effects([effect_class(name)(at=at, **values)]), longest=5e-4)
        made = [simulate_model(model, as_run(test), rounding=False, start_angle=START) for test in TESTS]
        return np.concatenate([[s.encoder, s.accel] for s in made], axis=1)

    less, as_it_is, more = (readings(share) for share in (0.999, 1.0, 1.001))
    assert np.linalg.norm(more - 2.0 * as_it_is + less) < 0.02 * np.linalg.norm(0.5 * (more - less))


def test_a_servos_readings_move_smoothly_with_load_friction_and_hardly_with_the_step():
    """A thousandth more must do what a thousandth less undoes; a quarter of the step changes less than 0.01 counts."""
    rig = Rig.model_validate(SERVO)
    tests = draw_servo_tests(np.random.default_rng(1), SERVO, 4)

    def readings(fraction: float, longest: float = 5e-4) -> np.ndarray:
        model = build(rig.with_effects([*rig.effects, effect_class("load_friction")(at="motor", fraction=fraction)]),
                      longest=longest)
        runs = [replace(as_run(test), t=np.arange(len(test.reference)) / rig.sample_rate) for test in tests]
        return np.concatenate([simulate_model(model, run, rounding=False, start_angle=START).encoder for run in runs])

    less, as_it_is, more = (readings(0.3 * share) for share in (0.999, 1.0, 1.001))
    assert np.linalg.norm(more - 2.0 * as_it_is + less) < 0.02 * np.linalg.norm(0.5 * (more - less))
    assert np.abs(readings(0.3, 1.25e-4) - as_it_is).max() < 0.01 and np.ptp(as_it_is) > 500.0


def test_a_users_own_effect_joins_without_recompiling_the_stepper(rig):
    """A law defined here, viscous drag, is the same as more motor damping, and the stepper stays as compiled."""
    simulate(rig.with_effects([friction("coulomb_friction", "motor")]), as_run(TESTS[0]))
    before = (list(stepper.ticks.signatures), dict(stepper.ticks.stats.cache_misses))

    def torque(x, v, w, p, s, h):
        return -p[0] * v

    class ViscousOfMyOwn(Effect):
        name = "viscous_of_my_own"
        sites: ClassVar = ("motor",)
        stage, law = Stage.TORQUE, torque
        coefficient: float = parameter("N m s/rad", 0.0, neutral=0.0)

        @classmethod
        def guesses(cls, rig, at):
            return [{"coefficient": 0.1 * rig.motor.damping}]

    try:
        own = rig.with_effects([ViscousOfMyOwn(at="motor", coefficient=0.03)])
        assert effect_class("viscous_of_my_own") is ViscousOfMyOwn
        assert Rig.from_toml(own.to_toml()).effects == own.effects
        made: Simulation = simulate_model(build(own, longest=1e-4), as_run(TESTS[0]), rounding=False)
        same = simulate_model(build(rig.with_constants({"motor.damping": rig.motor.damping + 0.03})),
                              as_run(TESTS[0]), rounding=False)
        none = simulate_model(build(rig), as_run(TESTS[0]), rounding=False)
    finally:
        ViscousOfMyOwn.name = ""  # leaves the catalogue
    np.testing.assert_allclose(made.encoder, same.encoder, atol=0.02)
    assert np.abs(none.encoder - same.encoder).max() > 1.0
    after = (list(stepper.ticks.signatures), dict(stepper.ticks.stats.cache_misses))
    assert after == before


@pytest.mark.parametrize("name", [name for name, cls in catalogue().items()
                                  if any(info.periodic for info in cls.parameters().values())])
def test_guesses_of_a_phase_go_all_round(rig, name):
    """Screening promises nothing to what points the other way, so no phase may lie far from a guess."""
    cls = catalogue()[name]
    for phase in (key for key, info in cls.parameters().items() if info.periodic):
        rounds: dict[tuple, list[float]] = {}
        for guess in cls.guesses(rig, cls.sites[0]):
            others = tuple(value for key, value in guess.items() if key != phase)
            rounds.setdefault(others, []).append(guess[phase] % (2.0 * math.pi))
        for phases in rounds.values():
            gaps = np.diff([*sorted(phases), min(phases) + 2.0 * math.pi])
            assert gaps.max() <= 0.5 * math.pi + 1e-9


@pytest.mark.parametrize("name", list(catalogue()))
@pytest.mark.parametrize("table", [SFLR, TWO_MASS, SERVO], ids=lambda table: table["name"])
def test_guesses_suit_a_rig_of_any_unit_of_torque(table, name):
    cls, own = catalogue()[name], Rig.model_validate(table)
    for at in (at for at in cls.sites if cls.fits(own, at)):
        larger = cls.guesses(rescaled(own, torque=50.0), at)
        for mine, theirs in zip(cls.guesses(own, at), larger, strict=True):
            for key, info in cls.parameters().items():
                assert theirs[key] == pytest.approx(mine[key] * 50.0 ** dimension(info.unit)[0])


@pytest.mark.parametrize("name", list(catalogue()))
def test_a_guess_made_as_small_as_what_was_found_is_as_large(rig, name):
    """Only sizes move: no phase, limit or rest angle; and none is made larger, or moved to neutral's other side."""
    cls = catalogue()[name]
    at = next(at for at in cls.sites if cls.fits(rig, at))
    sizes = {key: info.neutral for key, info in cls.parameters().items()
             if info.neutral is not None and math.isfinite(info.neutral)}
    usual = cls.guesses(rig, at)
    for guess in usual:
        assert bool(sizes) == any(one == pytest.approx(cls.sized(guess, 0.01))
                                  for one in cls.smaller(usual, cls.sized(guess, 0.01)))
        assert all(0.0 < (one[key] - neutral) / (guess[key] - neutral) < 1.0 + 1e-9
                   for one in cls.smaller(usual, cls.sized(guess, 0.9)) for key, neutral in sizes.items()
                   if len(sizes) == 1)
        assert not cls.smaller(usual, cls.sized(guess, 1e3))


def test_guesses_of_a_speed_are_in_proportion_to_that_of_the_runs(rig):
    cls = effect_class("stribeck_friction")
    slow, usual = (cls.guesses_at(rig, "motor", speed) for speed in (0.01 * USUAL_SPEED, USUAL_SPEED))
    assert usual == cls.guesses(rig, "motor")
    assert [one["stribeck_velocity"] for one in slow] == pytest.approx([0.01 * u["stribeck_velocity"] for u in usual])
    assert [one | {"stribeck_velocity": 0} for one in slow] == [one | {"stribeck_velocity": 0} for one in usual]
    assert cls.guesses_at(rig, "motor", 1e-9)[0]["stribeck_velocity"] == cls.parameters()["stribeck_velocity"].low


def test_guesses_of_quadratic_drag_brake_slow_runs_as_much_as_others(rig):
    cls = effect_class("quadratic_drag")
    usual = cls.guesses(rig, "base")
    for speed in (0.02, USUAL_SPEED, 9.0):
        for guess, of in zip(cls.guesses_at(rig, "base", speed), usual, strict=True):
            braked = cls.law(0.0, speed, 0.0, list(guess.values()), [], 1e-3)
            assert braked == pytest.approx(cls.law(0.0, USUAL_SPEED, 0.0, list(of.values()), [], 1e-3))


@pytest.mark.parametrize("cls", [cls for cls in catalogue().values() if cls.simpler], ids=lambda cls: cls.name)
def test_a_law_with_special_cases_is_them_where_it_says_so(cls):
    """All other parameters of a unit that a special case has are like its own: friction of one level at all speeds."""
    for name, its in cls.simpler.items():
        other = effect_class(name)
        assert set(its) == set(other.parameters()) and set(cls.sites) <= set(other.sites)
        units = {other.parameters()[own].unit: 0.3 for own in its}
        p = [units.get(info.unit, 0.7) for info in cls.parameters().values()]
        for speed in (0.0, 0.1, 0.7, 5.0):
            theirs = other.law(speed, 0.0, 0.0, [0.3] * len(its), [], 1e-3)
            assert cls.law(speed, 0.0, 0.0, p, [], 1e-3) == pytest.approx(theirs)


@pytest.mark.parametrize("others", [(), (("dead_zone", {"width": 20.0}), ("gain_curve", {"exponent": 0.3}))], ids=str)
def test_a_command_bias_is_a_constant_torque_on_the_motor(rig, others):
    """So it is told with what is one, too (``alike``): at the amplifier's limit as well, and behind a dead zone."""
    beside = [effect_class(name)(at="amplifier", **values) for name, values in others]
    t = np.arange(1500) / rig.sample_rate
    command = 1.5 * rig.amplifier.limit * np.sin(9.0 * t)
    run = Run("x", t, command, command, 0.0 * t, None, RunMetadata(controller={"kind": "open"}))
    bias = effect_class("command_bias")(at="amplifier", offset=8.0)

    def angle(effects: list[Effect], constant: float) -> np.ndarray:
        return simulate_model(build(rig.with_effects(effects)), run, rounding=False, more=(0.0, constant)).encoder

    biased = angle([*beside, bias], 0.0)
    np.testing.assert_allclose(biased, angle(beside, 8.0), atol=1e-6)
    assert np.abs(biased - angle(beside, 0.0)).max() > 10.0 and np.abs(biased - angle(beside, -8.0)).max() > 10.0
    assert "constant torque on the motor" in bias.alike


@pytest.mark.parametrize(("counts", "leads"), [(628318.5, 5), (1024.0, 0)])
def test_a_ball_screws_turns_are_among_the_ripples_of_an_axis_in_metres(rig, counts, leads):
    """As far as its encoder shows them."""
    axis = rig.with_constants({"encoder.counts_per_revolution": counts})
    cycles = {guess["cycles"] for guess in effect_class("torque_ripple").guesses(axis, "motor")}
    found = [lead for lead in (0.04, 0.02, 0.01, 0.005, 0.0025) if np.isclose(list(cycles), 2.0 * math.pi / lead).any()]
    assert len(found) == leads
    assert all(effect_class("torque_ripple")(at="motor", amplitude=0.1, cycles=one, phase=0.0) for one in cycles)
