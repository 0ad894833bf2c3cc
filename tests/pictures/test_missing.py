"""The missing torque: torques of the independent generator are found, with honest uncertainty."""

import numpy as np
import pytest
import scipy.linalg

from station.errors import UsageError, WorkError
from station.model.assembly import assemble, state_matrix, torque_input
from station.model.effects import effect_class
from station.pictures.missing import missing_torque
from station.pictures.plant import port_vector
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.truth import CONTROLLERS, RIGID_AXIS, SFLR, TWO_MASS, Conditions, pulse_test, simulate_case, step_test

RATE = 500.0
TESTS = [step_test(RATE, "lead", 100.0, 1.4), pulse_test(RATE, 120.0, 0.1, duration=1.4)]
FRICTION = {"effect": "coulomb_friction", "at": "motor", "torque": 0.06}
RIG = load_rig("sflr")


def made(effects: list[dict], table: dict = SFLR, **conditions) -> list[tuple[Run, np.ndarray]]:
    """Runs of the independent generator, and the motor's dry friction in them as a run's row would hold it."""
    given = [Conditions(accel_sigma=1.0, accel_offset=3.0, seed=i, **conditions) for i in range(len(TESTS))]
    found = []
    for test, out in zip(TESTS, simulate_case(table, effects, TESTS, given), strict=True):
        controller = CONTROLLERS[test.controller]
        meta = RunMetadata(controller=controller, command_row=0 if controller["kind"] == "open" else -1,
                           start=conditions.get("start", "released"))
        run = Run(test.name, out.t, out.reference, out.command, out.encoder, out.accel, meta)
        found.append((run, np.append(out.trace[1:, 10], out.trace[-1, 10])))
    return found


def effect(row: dict):
    return effect_class(row["effect"])(**{key: value for key, value in row.items() if key != "effect"})


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_nothing_is_missing_from_runs_of_the_very_rig():
    for run, _ in made([]):
        found = missing_torque(RIG, run)
        assert rms(found.torque) < 0.003 * RIG.motor.gain * RIG.amplifier.limit
        assert rms(found.torque / found.sigma) < 1.5


def test_friction_is_found_with_honest_uncertainty():
    for run, true in made([FRICTION]):
        found = missing_torque(RIG, run)
        error = found.torque - true
        assert rms(error) < 0.35 * rms(true)
        assert 0.5 < rms(error / found.sigma) < 1.3
        assert np.mean(np.abs(error) < 2.0 * found.sigma) > 0.9
        fast = np.abs(found.speed) > 0.7
        assert np.median(-np.sign(found.speed[fast]) * found.torque[fast]) == pytest.approx(0.06, rel=0.1)


@pytest.mark.parametrize("at", ["motor", "base", "drive", "clamp", "tip"])
def test_a_known_torque_is_found_where_it_acts(at):
    """A torque of a few sines drives the undivided state equation; rounding and noise as a log has them."""
    parts, rng = assemble(RIG), np.random.default_rng(5)
    n, rows, t = parts.size, 800, np.arange(800) / RATE
    a = state_matrix(parts)
    b = torque_input(parts, port_vector(RIG, parts, at))
    sampled = scipy.linalg.expm(np.block([[a, b[:, None]], [np.zeros((1, 2 * n + 1))]]) / RATE)
    torque = sum(0.1 * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.8, 1.7, 3.1)) * (t > 0.2)
    x, encoder, accel, before = np.zeros(2 * n), np.zeros(rows), np.zeros(rows), 0.0
    angle = np.zeros(rows)
    for k in range(rows):
        encoder[k] = x[parts.base] / RIG.angle_per_count
        accel[k] = RIG.accelerometer.gain * (a[n + parts.tip] @ x + b[n + parts.tip] * before)
        angle[k] = port_vector(RIG, parts, at) @ x[:n]
        before = torque[k]
        x = sampled[:-1, :-1] @ x + sampled[:-1, -1] * before
    accel = accel + 4.0 + rng.standard_normal(rows)
    zero = np.zeros(rows)
    run = Run("pushed", t, zero, zero, np.floor(encoder + 0.5), np.floor(accel + 0.5), RunMetadata())
    found = missing_torque(RIG, run, at)
    error = (found.torque - torque)[:-25]
    assert rms(error) < 0.15 * rms(torque), rms(error)
    assert rms(error / found.sigma[:-25]) < 2.0
    assert rms(found.angle - angle) < 0.2 * rms(angle) + 0.002


COMMAND_PATH = [{"effect": "input_delay", "at": "amplifier", "time": 0.0047},
                {"effect": "actuator_lag", "at": "amplifier", "time_constant": 0.008},
                {"effect": "dead_zone", "at": "amplifier", "width": 6.0},
                {"effect": "gain_curve", "at": "amplifier", "exponent": 0.2},
                {"effect": "command_bias", "at": "amplifier", "offset": 5.0},
                {"effect": "clock_scale", "at": "clock", "ratio": 1.03},
                {"effect": "encoder_delay", "at": "encoder", "time": 0.0047},
                {"effect": "accelerometer_lag", "at": "accelerometer", "time_constant": 0.004}]


@pytest.mark.parametrize("row", COMMAND_PATH, ids=lambda row: row["effect"])
def test_what_the_rig_holds_in_its_command_and_sensors_is_not_missing(row):
    for run, _ in made([row]):
        held, not_held = (missing_torque(rig, run) for rig in (RIG.with_effects([effect(row)]), RIG))
        assert rms(held.torque) < 0.01
        if row["at"] == "accelerometer":  # no torque explains it
            assert not_held.mistrust > 1.0
        else:
            assert rms(held.torque) < 0.35 * rms(not_held.torque)


HELD = [{"effect": "cable_spring", "at": "base", "stiffness": 0.15, "rest": 0.3},
        {"effect": "torque_ripple", "at": "motor", "amplitude": 0.05, "cycles": 6.0, "phase": 1.0},
        {"effect": "quadratic_drag", "at": "base", "coefficient": 0.03},
        {"effect": "load_friction", "at": "drive", "fraction": 0.3},
        {"effect": "hardening_spring", "at": "drive", "cubic": 2.0},
        {"effect": "hardening_spring", "at": "clamp", "cubic": 300.0},
        {"effect": "backlash", "at": "drive", "gap": 0.03}]


@pytest.mark.parametrize("row", HELD, ids=lambda row: f"{row['effect']}@{row['at']}")
def test_torques_that_the_rig_holds_anywhere_are_not_missing(row):
    for run, _ in made([row]):
        held, not_held = (missing_torque(rig, run) for rig in (RIG.with_effects([effect(row)]), RIG))
        assert rms(held.torque) < (0.1 if row["at"] == "clamp" else 0.05)  # the motor has 2.1 N m
        assert rms(held.torque) < 0.65 * rms(not_held.torque)


def test_friction_beside_an_effect_that_the_rig_holds():
    cable = HELD[0]
    for run, true in made([cable, FRICTION]):
        found = missing_torque(RIG.with_effects([effect(cable)]), run)
        assert rms(found.torque - true) < 0.35 * rms(true)


def test_dry_friction_that_the_rig_holds_is_taken_off_while_it_moves():
    for run, true in made([FRICTION]):
        found, plain = (missing_torque(rig, run) for rig in (RIG.with_effects([effect(FRICTION)]), RIG))
        fast = np.abs(found.speed) > 1.0
        assert rms(found.torque[fast]) < 0.5 * rms(plain.torque[fast])
        assert np.abs(found.torque).max() < 1.5 * np.abs(true).max()


def test_an_equilibrium_start_shows_the_torque_that_held_before():
    """A bias that the rig holds pushes; that nothing moves at first says what friction must have held."""
    bias = {"effect": "command_bias", "at": "amplifier", "offset": 4.0}
    for run, _ in made([bias, FRICTION], start="equilibrium"):
        found = missing_torque(RIG.with_effects([effect(bias)]), run)
        assert np.median(found.torque[:80]) == pytest.approx(-4.0 * RIG.motor.gain, rel=0.06)


@pytest.mark.parametrize("table", [RIGID_AXIS, TWO_MASS], ids=lambda table: table["name"])
def test_rigs_without_beam_or_drive(table):
    rig = Rig.model_validate(table)
    for run, true in made([FRICTION | {"torque": 0.05}], table):
        assert run.accel is None
        found = missing_torque(rig, run)
        assert rms(found.torque - true) < 0.45 * rms(true)
        assert rms(missing_torque(rig, run, "base").torque) > 0.5 * rms(true)


def test_an_accelerometer_that_no_torque_explains_is_not_believed(monkeypatch):
    """A softer beam in truth: torque is not made up for what the tip does; where torque explains it, it is believed."""
    soft = {"effect": "parameter:beam.flexural_rigidity", "at": "", "value": 0.5 * 0.21}
    runs = made([soft])
    wary = [missing_torque(RIG, run) for run, _ in runs]
    assert all(found.mistrust > 1.0 for found in wary)
    assert all(missing_torque(RIG, run).mistrust == 1.0 for run, _ in made([FRICTION]))
    monkeypatch.setattr("station.pictures.missing.MISTRUST", (1.0,))
    for (run, _), found in zip(runs, wary, strict=True):
        assert rms(found.torque) < 0.7 * rms(missing_torque(RIG, run).torque)


def test_without_the_accelerometer_the_encoder_alone_still_finds_friction():
    run, true = made([FRICTION])[1]
    both, alone = missing_torque(RIG, run), missing_torque(RIG, run, accelerometer=False)
    assert rms(both.torque - true) < rms(alone.torque - true) < 0.6 * rms(true)
    assert np.mean(alone.sigma) > np.mean(both.sigma)


@pytest.mark.parametrize("at", ["drive", "clamp", "tip", "nose"])
def test_a_place_that_the_rig_lacks_is_refused_in_one_line(at):
    run, _ = made([], RIGID_AXIS)[0]
    with pytest.raises(UsageError, match=f"missing torque at '{at}': rig axis has no such place"):
        missing_torque(Rig.model_validate(RIGID_AXIS), run, at)


def test_a_run_with_lost_samples_is_refused():
    run, _ = made([])[0]
    rows = np.arange(len(run.t)) + (np.arange(len(run.t)) > 100)
    broken = Run("broken", rows / RATE, run.reference, run.command, run.encoder, run.accel, run.metadata, n=rows)
    with pytest.raises(WorkError, match="samples lost"):
        missing_torque(RIG, broken)
