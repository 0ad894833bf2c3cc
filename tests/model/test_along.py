"""The load on a motor's gears along a motion, and the command that reaches it, against what the stepper does."""

import numpy as np
import pytest

from station.model import stepper
from station.model.along import axis_load, effective_command, equivalent_stiffness
from station.model.assembly import assemble
from station.model.effects import effect_class
from station.model.simulate import build, initial_state
from station.rig import Rig
from tests.truth import RIGID_AXIS, SFLR, TWO_MASS

RATE = 500.0
COMMAND = np.repeat([0.0, 90.0, -60.0, 30.0, 0.0, -120.0], 60)


def made(table: dict, *rows: tuple[str, str, dict]) -> Rig:
    kept = {key: value for key, value in table.items() if key != "uncertainty"}
    return Rig.model_validate(kept).with_effects([effect_class(name)(at=at, **values) for name, at, values in rows])


def motion(rig: Rig, command: np.ndarray, zero: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Angles and speeds (n + 1, coordinates) at the ticks of an open loop."""
    model = build(rig, truncation=0.0, longest=1e-4)
    state, work, out = initial_state(model, zero=zero), stepper.working_room(model.plan), np.zeros(2)
    n = model.assembly.size
    stepper.begin(model.plan, state)
    rows = [model.form.basis @ state.z]
    for count in command:
        stepper.tick(model.plan, state, float(count), 0.0, False, work, out)
        rows.append(model.form.basis @ state.z)
    rows = np.array(rows)
    return rows[:, :n], rows[:, n:]


@pytest.mark.parametrize("rows", [
    [], [("dead_zone", "amplifier", {"width": 20.0}), ("command_bias", "amplifier", {"offset": 5.0})],
    [("input_delay", "amplifier", {"time": 0.0047})], [("gain_curve", "amplifier", {"exponent": 0.3})],
    [("actuator_lag", "amplifier", {"time_constant": 0.01}), ("clock_scale", "clock", {"ratio": 1.05})]], ids=str)
def test_the_command_that_reaches_the_motor_is_what_turns_it(rows):
    """On a motor without damping J dw = gain * command * T, tick by tick."""
    free = {**RIGID_AXIS, "motor": {"inertia": 0.02, "damping": 0.0, "gain": 0.01}}
    rig = made(free, *rows)
    found = effective_command(rig, COMMAND)
    period = (1.05 if "clock_scale" in str(rows) else 1.0) / RATE
    turned = np.diff(motion(rig, COMMAND)[1][:, 0]) * 0.02 / (0.01 * period)
    np.testing.assert_allclose(found, turned, atol=1e-3)
    assert np.ptp(found) > 50.0 and (not rows or np.abs(found - COMMAND).max() > 1.0)


def test_without_effects_the_command_reaches_the_motor_as_it_is():
    np.testing.assert_allclose(effective_command(made(RIGID_AXIS), COMMAND), COMMAND, atol=1e-9)


ARM = {key: value for key, value in SFLR.items() if key != "drive"}
LOAD = ("load_friction", "motor", {"fraction": 0.3})
RUBBING = RIGID_AXIS | {"motor": RIGID_AXIS["motor"] | {"back_emf": 0.3}}


@pytest.mark.parametrize(("table", "others"), [
    (RIGID_AXIS, [("gravity_tilt", "base", {"torque": 0.6, "angle": 0.2})]),
    (RIGID_AXIS, [("torque_ripple", "motor", {"amplitude": 0.1, "cycles": 3.0, "phase": 1.0})]),
    (RUBBING, [("gravity_tilt", "base", {"torque": 0.6, "angle": 0.2})]),
    (ARM, [("cable_spring", "base", {"stiffness": 0.5, "rest": 0.1})]),
    (ARM, [("hardening_spring", "clamp", {"cubic": 2000.0})]),
], ids=["pendulum", "ripple", "rubbing bearings", "arm with cable", "arm with hardening clamp"])
def test_friction_along_a_motion_is_the_fraction_of_the_load(table, others):
    """While the motor turns one way, what the equations of motion leave over is -fraction |load| sign(speed)."""
    rig, free = made(table, *others, LOAD), made(table, *others)
    command = 0.8 * COMMAND
    angle, speed = motion(rig, command)
    parts = assemble(rig)
    mean = 0.5 * (angle[1:] + angle[:-1]), 0.5 * (speed[1:] + speed[:-1])
    load = axis_load(free, effective_command(rig, command), *mean)
    force = parts.mass @ np.diff(speed, axis=0).T * RATE + parts.damping @ mean[1].T + parts.stiffness @ mean[0].T
    acting = force[parts.motor] - rig.motor.gain * command
    for name, at, values in others:
        if at in ("base", "motor"):
            effect = effect_class(name)(at=at, **values)
            acting -= [type(effect).law(x, 0.0, 0.0, effect.arguments(rig), [0.0], 0.0) for x in mean[0][:, 0]]
        else:
            acting += values["cubic"] * (mean[0][:, parts.base] - mean[0][:, parts.root]) ** 3
    turns = np.abs(mean[1][:, 0]) > 0.1 * np.abs(mean[1]).max(axis=0)[0]
    steady = turns & np.r_[False, command[1:] == command[:-1]]
    wanted = -0.3 * np.abs(load) * np.sign(mean[1][:, 0])
    scale = np.abs(wanted[steady]).max()
    assert np.count_nonzero(steady) > 100
    assert np.median(np.abs(acting - wanted)[steady]) < 2e-3 * scale
    assert np.quantile(np.abs(acting - wanted)[steady], 0.9) < 0.05 * scale


TORQUES = (0.1 + 0.5 * np.abs(np.sin(np.arange(200.0)))) * np.where(np.arange(200) % 2, 1.0, -1.0)
STIFFNESS = TWO_MASS["drive"]["stiffness"]


def stiffness_of(name: str, **sizes: float) -> float:
    return equivalent_stiffness(made(TWO_MASS, (name, "drive", sizes)), "drive", TORQUES)


@pytest.mark.parametrize("gap", [0.0, 0.01, 0.1])
def test_a_play_adds_half_its_width_to_every_deflection(gap):
    compliance = 1.0 / STIFFNESS + 0.5 * gap * np.mean(1.0 / np.abs(TORQUES))
    assert stiffness_of("backlash", gap=gap) == pytest.approx(1.0 / compliance, rel=0.01)


@pytest.mark.parametrize("share", [0.0, 0.2, 5.0])
def test_a_hardening_spring_is_as_stiff_as_its_deflections_say(share):
    reach = np.abs(TORQUES).max() / STIFFNESS
    cubic = share * STIFFNESS / reach**2
    roots = [np.roots([cubic, 0.0, STIFFNESS, -torque]) if cubic else np.array([torque / STIFFNESS])
             for torque in TORQUES]
    deflection = np.array([found[np.argmin(np.abs(found.imag))].real for found in roots])
    found = stiffness_of("hardening_spring", cubic=cubic)
    assert found == pytest.approx(1.0 / np.mean(deflection / TORQUES), rel=0.001)
    assert (found > 1.01 * STIFFNESS) is (share > 0.0)


def test_a_spring_that_softens_until_it_carries_no_more_is_as_soft_as_where_it_carries_most():
    """k x - c x^3 carries most at x = sqrt(k/3c), 2/3 k x."""
    reach = np.abs(TORQUES).min() / STIFFNESS
    softened = stiffness_of("hardening_spring", cubic=-STIFFNESS / reach**2)
    assert softened == pytest.approx(2.0 / 3.0 * STIFFNESS, rel=0.02)


def test_a_joint_that_is_all_play_is_a_twentieth_as_stiff():
    assert stiffness_of("backlash", gap=100.0 * np.abs(TORQUES).max() / STIFFNESS) == pytest.approx(0.05 * STIFFNESS)
