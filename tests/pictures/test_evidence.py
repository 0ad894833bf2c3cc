"""Evidence: for every cause a picture whose points, measured, lie on the right law and not on a wrong one."""

import math
from typing import ClassVar

import numpy as np
import pytest

from station.model.effects import Effect, Stage, catalogue, effect_class
from station.model.effects.base import parameter
from station.pictures.evidence import evidence
from station.pictures.picture import POINTS, Evidence
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.truth import (
    CONTROLLERS,
    RIGID_AXIS,
    SFLR,
    Conditions,
    Test,
    pulse_test,
    simulate_case,
    step_test,
    sweep_test,
)

RATE = 500.0
RIG = load_rig("sflr")
TESTS = [step_test(RATE, "lead", 100.0, 1.4), pulse_test(RATE, 150.0, 0.15, duration=1.4),
         sweep_test(RATE, 60.0, 0.5, 15.0, 3.0)]
VALUES = {
    ("accelerometer_centripetal", "accelerometer"): {"fraction": 0.6},
    ("accelerometer_delay", "accelerometer"): {"time": 0.004},
    ("accelerometer_highpass", "accelerometer"): {"time_constant": 0.15},
    ("accelerometer_lag", "accelerometer"): {"time_constant": 0.006},
    ("accelerometer_saturation", "accelerometer"): {"limit": 25.0},
    ("actuator_lag", "amplifier"): {"time_constant": 0.008},
    ("actuator_saturation", "amplifier"): {"limit": 90.0},
    ("backlash", "drive"): {"gap": 0.05},
    ("cable_spring", "base"): {"stiffness": 0.15, "rest": 0.2},
    ("clock_scale", "clock"): {"ratio": 1.05},
    ("command_bias", "amplifier"): {"offset": 6.0},
    ("coulomb_friction", "motor"): {"torque": 0.08},
    ("coulomb_friction", "base"): {"torque": 0.08},
    ("dead_zone", "amplifier"): {"width": 8.0},
    ("encoder_delay", "encoder"): {"time": 0.005},
    ("encoder_eccentricity", "encoder"): {"amplitude": 5.0, "phase": -0.4},
    ("gain_asymmetry", "amplifier"): {"ratio": 1.3},
    ("gain_curve", "amplifier"): {"exponent": 0.3},
    ("gravity_tilt", "base"): {"torque": 0.08, "angle": 0.4},
    ("hardening_spring", "drive"): {"cubic": 2.0},
    ("hardening_spring", "clamp"): {"cubic": 120.0},
    ("input_delay", "amplifier"): {"time": 0.005},
    ("load_friction", "drive"): {"fraction": 0.4},
    ("quadratic_drag", "base"): {"coefficient": 0.03},
    ("stribeck_friction", "motor"): {"static_torque": 0.12, "coulomb_torque": 0.08, "stribeck_velocity": 0.3},
    ("sublinear_drag", "motor"): {"coefficient": 0.15, "speed": 0.8},
    ("torque_ripple", "motor"): {"amplitude": 0.08, "cycles": 6.0, "phase": 1.0},
}
KEYS = [(name, at) for name, cls in catalogue().items() for at in cls.sites
        if cls.__module__.startswith("station.model.effects") and cls.fits(RIG, at)]
SIZE = {"stribeck_friction": ("static_torque", "coulomb_torque"), "encoder_eccentricity": ("amplitude",),
        "cable_spring": ("stiffness",), "gravity_tilt": ("torque",), "torque_ripple": ("amplitude",),
        "sublinear_drag": ("coefficient",)}
KINDS = {"speed", "angle", "load", "deflection", "command", "frequency", "acceleration"}


def made(rows: list[dict], table: dict = SFLR, tests: list[Test] = TESTS, **facts) -> list[Run]:
    given = [Conditions(accel_sigma=1.0, accel_offset=3.0, seed=i) for i in range(len(tests))]
    runs = []
    for test, out in zip(tests, simulate_case(table, rows, tests, given), strict=True):
        controller = CONTROLLERS[test.controller]
        meta = RunMetadata(controller=controller, command_row=0 if controller["kind"] == "open" else -1,
                           zero_id="bench")
        runs.append(Run(test.name, out.t, out.reference, out.command, out.encoder, out.accel, meta, **facts))
    return runs


def fit(picture: Evidence) -> float:
    """Share of what the points stand off from no effect that the law takes away; 1 is all, below 0 worse than none.

    Of friction only points that move count: at rest it may hold anything.
    """
    x, y = picture.x, picture.y
    if picture.kind == "speed" and "At rest" in picture.note:
        x, y = x[np.abs(picture.x) > 0.5], y[np.abs(picture.x) > 0.5]
    law, none = np.interp(x, picture.law_x, picture.law_y), np.zeros(len(x))
    if picture.without_y is not None:
        none = picture.without_y
    elif picture.kind == "acceleration":
        none = x
    elif "Share" in picture.title:
        none = np.ones(len(x))
    elif picture.kind == "deflection":
        none = np.polyval(np.polyfit(picture.law_x[150:250], picture.law_y[150:250], 1), x)
    return 1.0 - float(np.sum((y - law) ** 2) / np.sum((y - none) ** 2))


def test_every_effect_is_tried_here():
    assert set(VALUES) == set(KEYS)


@pytest.mark.parametrize("key", KEYS, ids="@".join)
def test_points_lie_on_the_effects_law_and_not_on_one_twice_as_large(key):
    name, at = key
    values = VALUES[key]
    runs = made([{"effect": name, "at": at, **values}])
    extended = RIG.with_effects([effect_class(name)(at=at, **values)])
    *pictures, sceptic = evidence(RIG, extended, runs, [key])
    assert pictures and sceptic.kind == "time" and sceptic.law_y is None

    assert max(fit(p) for p in pictures) > 0.5
    for picture in pictures:
        assert picture.kind in KINDS and picture.title.endswith(catalogue()[name].title)
        assert 0 < len(picture.x) == len(picture.y) <= POINTS and len(picture.law_x) == len(picture.law_y)
        assert np.all(np.isfinite(picture.x)) and np.all(np.isfinite(picture.y)) and np.all(np.isfinite(picture.law_y))
        assert "Points:" in picture.note and "Line:" in picture.note
    best = max(pictures, key=fit)
    wrong = {p: values[p] ** 2 if p == "ratio" else 2.0 * values[p] for p in SIZE.get(name, tuple(values))}
    other = RIG.with_effects([effect_class(name).model_construct(at=at, **(values | wrong))])
    same = [p for p in evidence(RIG, other, runs, [key]) if p.title == best.title]
    assert same and fit(same[0]) < fit(best) - 0.1


@pytest.mark.parametrize("path", ["tip.mass", "motor.damping", "drive.damping", "accelerometer.gain"])
def test_a_constant_that_is_off_moves_the_response_to_where_it_was_measured(path):
    value = 1.6 * RIG.constants()[path]
    runs = made([{"effect": f"parameter:{path}", "at": "", "value": value}])
    extended = RIG.with_constants({path: value})
    picture, _ = evidence(RIG, extended, runs, [(f"parameter:{path}", "")])
    assert picture.kind == "frequency" and path in picture.title and len(picture.x) > 5
    assert fit(picture) > 0.6
    assert "Modes below" in picture.note and "Hz becomes" in picture.note
    opposite = RIG.with_constants({path: RIG.constants()[path] / 1.6})
    wrong, _ = evidence(RIG, opposite, runs, [(f"parameter:{path}", "")])
    assert fit(wrong) < 0.0


def test_a_high_pass_is_drawn_where_it_acts_and_no_point_lies_far_from_its_law():
    """At low frequency, where few spectral lines are: points that are not sure are left out, not drawn at random."""
    runs = made([{"effect": "accelerometer_highpass", "at": "accelerometer", "time_constant": 0.15}])
    extended = RIG.with_effects([effect_class("accelerometer_highpass")(at="accelerometer", time_constant=0.15)])
    size, phase, _ = evidence(RIG, extended, runs, [("accelerometer_highpass", "accelerometer")])
    for picture, most in ((size, 1.8), (phase, 12.0)):      # twice the largest standard error: 0.9 dB, 6 degrees
        assert picture.x.min() < 1.5 and len(picture.x) >= 10
        assert np.abs(picture.y - picture.law_y).max() < most
    assert size.law_y[0] < -1.0 and phase.law_y[0] > 20.0


def test_each_of_two_causes_is_drawn_without_the_other():
    rows = [{"effect": "coulomb_friction", "at": "motor", "torque": 0.08},
            {"effect": "cable_spring", "at": "base", "stiffness": 0.15, "rest": 0.2}]
    extended = RIG.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.08),
                                 effect_class("cable_spring")(at="base", stiffness=0.15, rest=0.2)])
    pictures = evidence(RIG, extended, made(rows), [("coulomb_friction", "motor"), ("cable_spring", "base")])
    assert [p.kind for p in pictures] == ["speed", "angle", "time"]
    assert fit(pictures[0]) > 0.6 and fit(pictures[1]) > 0.4


def test_without_a_cause_the_sceptic_draws_the_missing_torque_against_everything():
    runs = made([{"effect": "coulomb_friction", "at": "motor", "torque": 0.08}])
    pictures = evidence(RIG, RIG, runs, [])
    assert [p.kind for p in pictures] == ["time", "speed", "angle", "command", "load", "spectrum"]
    for picture in pictures:
        assert picture.law_x is None and "Nothing is assumed" in picture.note
        assert 0 < len(picture.x) == len(picture.y) <= POINTS
    assert np.all(pictures[-1].y > 0.0)


def test_the_sceptic_draws_the_run_that_misses_most():
    quiet = made([], tests=TESTS[:1])
    loud = made([{"effect": "coulomb_friction", "at": "motor", "torque": 0.08}], tests=TESTS[1:2])
    assert loud[0].name in evidence(RIG, RIG, quiet + loud, [])[0].note


def test_a_cause_that_the_extended_rig_does_not_hold_is_passed_over():
    runs = made([], tests=TESTS[:1])
    causes = [("coulomb_friction", "motor"), ("parameter:clamp.nonsense", ""), ("parameter:tip.inertia", "")]
    assert [p.kind for p in evidence(RIG, RIG, runs, causes[:2])] == ["time", "speed", "angle", "command", "load",
                                                                     "spectrum"]
    assert evidence(RIG, RIG, runs, causes)[-1].kind in ("time", "spectrum")
    assert evidence(RIG, RIG, [], []) == []


def test_angles_of_runs_with_another_zero_are_left_out():
    row = {"effect": "cable_spring", "at": "base", "stiffness": 0.15, "rest": 0.2}
    extended = RIG.with_effects([effect_class("cable_spring")(at="base", stiffness=0.15, rest=0.2)])
    first, second, _ = made([row])
    other = Run(second.name, second.t, second.reference, second.command, second.encoder, second.accel,
                second.metadata.model_copy(update={"zero_id": "elsewhere"}))
    assert "1 run " in evidence(RIG, extended, [first, other], [("cable_spring", "base")])[0].note
    assert "2 runs " in evidence(RIG, extended, [first, second], [("cable_spring", "base")])[0].note


def test_a_rigid_axis_has_its_pictures():
    rig = Rig.model_validate(RIGID_AXIS)
    for name, at, values in (("coulomb_friction", "motor", {"torque": 0.05}), ("dead_zone", "amplifier",
                             {"width": 10.0}), ("input_delay", "amplifier", {"time": 0.006})):
        runs = made([{"effect": name, "at": at, **values}], RIGID_AXIS)
        picture, _ = evidence(rig, rig.with_effects([effect_class(name)(at=at, **values)]), runs, [(name, at)])
        assert fit(picture) > 0.5, name


def test_host_time_shows_the_clock():
    rows = [{"effect": "clock_scale", "at": "clock", "ratio": 1.05}]
    t = np.arange(len(TESTS[0].reference)) / RATE
    runs = made(rows, tests=TESTS[:1], device_time=t, host_time=7.0 + 1.05 * t)
    extended = RIG.with_effects([effect_class("clock_scale")(at="clock", ratio=1.05)])
    drift = evidence(RIG, extended, runs, [("clock_scale", "clock")])[0]
    assert drift.kind == "time" and "clock" in drift.title
    np.testing.assert_allclose(drift.y, np.interp(drift.x, drift.law_x, drift.law_y), atol=1e-6)
    assert drift.law_y[-1] == pytest.approx(50.0 * t[-1])


def test_an_effect_of_a_users_own_is_drawn_by_its_stage_and_picture():
    def torque(x, v, w, p, s, h):
        return -p[0] * math.tanh(3.0 * v)

    class Smooth(Effect):
        name, title = "smooth_friction_of_my_own", "smooth friction"
        sites: ClassVar = ("motor", "base")
        stage, law, picture = Stage.TORQUE, torque, "speed"
        level: float = parameter("N m", 0.0, neutral=0.0)

        @classmethod
        def guesses(cls, rig, at):
            return [{"level": 0.05}]

    try:
        runs = made([{"effect": "coulomb_friction", "at": "motor", "torque": 0.08}])
        extended = RIG.with_effects([Smooth(at="motor", level=0.08)])
        picture, _ = evidence(RIG, extended, runs, [("smooth_friction_of_my_own", "motor")])
        Smooth.picture = "time"
        plain, _ = evidence(RIG, extended, runs, [("smooth_friction_of_my_own", "motor")])
    finally:
        Smooth.name = ""  # leaves the catalogue
    assert picture.kind == "speed" and fit(picture) > 0.5
    assert plain.kind == "time" and fit(plain) > 0.5, "the law along the motion"


def test_friction_is_drawn_against_speed_whatever_picture_its_effect_names(monkeypatch):
    """The level of friction is a law of speed; against the angle a line through the points would be another law's."""
    cls = effect_class("coulomb_friction")
    runs = made([{"effect": "coulomb_friction", "at": "motor", "torque": 0.08}])
    extended = RIG.with_effects([cls(at="motor", torque=0.08)])
    usual, _ = evidence(RIG, extended, runs, [("coulomb_friction", "motor")])
    monkeypatch.setattr(cls, "picture", "angle")
    picture, _ = evidence(RIG, extended, runs, [("coulomb_friction", "motor")])
    assert (picture.kind, picture.title, picture.xlabel) == (usual.kind, usual.title, usual.xlabel)
    np.testing.assert_array_equal(picture.x, usual.x)


STIFF = {"name": "two inertias", "sample_rate": 500.0, "motor": {"inertia": 4e-4, "damping": 3e-3, "gain": 4e-4},
         "drive": {"stiffness": 9.0, "damping": 0.005}, "base": {"inertia": 1e-3},
         "encoder": {"counts_per_revolution": 8192.0}, "amplifier": {"limit": 1000.0}}
"""Two inertias of which the encoder reads the second."""


@pytest.mark.parametrize(("lost", "shown"), [(0.0, True), (0.004, False)])
def test_play_is_drawn_only_where_the_wind_up_is_seen(lost, shown):
    """Friction at the motor that the model lacks, a hundredth of its torque, lets the estimated wind-up run away."""
    rig, play = Rig.model_validate(STIFF), {"effect": "backlash", "at": "drive", "gap": 0.03}
    rows = [play, {"effect": "coulomb_friction", "at": "motor", "torque": lost}][: 2 if lost else 1]
    extended = rig.with_effects([effect_class("backlash")(at="drive", gap=0.03)])
    picture, _ = evidence(rig, extended, made(rows, STIFF, [sweep_test(RATE, 600.0, 0.7, 12.0, 4.0)]),
                          [("backlash", "drive")])
    assert picture.drawn == shown
    assert ("Not drawn: these runs do not show the wind-up of the drive." in picture.note) != shown
    assert not shown or np.abs(picture.x).max() < 0.2
