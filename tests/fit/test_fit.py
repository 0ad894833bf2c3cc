"""Fitting the rig's constants: finds a hidden rig again, and says what the data cannot hold."""

from dataclasses import replace

import numpy as np
import pytest

from station.errors import UsageError, WorkError
from station.fit import fit
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.model.units import powers
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from station.runs.store import load_run
from tests.measured import measured_log

SCALES = ("beam.mass_per_length", "beam.length")
"""What a balance and a ruler give: with both held, the data hold everything that they see at all."""


def sent(name: str, reference: np.ndarray, controller: dict) -> Run:
    zero = np.zeros(len(reference))
    command = reference if controller["kind"] == "open" else zero
    return Run(name, np.arange(len(reference)) / 500.0, reference, command, zero, zero,
               RunMetadata(controller=controller, command_row=-1))


def runs_on(rig: Rig, seed: int = 0) -> list[Run]:
    """A pulse, a P step and a sweep, rounded, with one count of accelerometer noise."""
    rng, t = np.random.default_rng(seed), np.arange(1000) / 500.0
    pulse = 100.0 * ((t >= 0.04) & (t < 0.14)) - 100.0 * ((t >= 1.4) & (t < 1.5))
    swept = np.arange(2500) / 500.0
    plan = [sent("pulse", pulse, {"kind": "open"}),
            sent("step", np.where(t >= 0.1, 50.0, 0.0), {"kind": "p", "gain": 2.0}),
            sent("sweep", 60.0 * np.sin(2 * np.pi * (0.5 + 2.5 * swept) * swept) * (swept > 0.1),
                 {"kind": "p", "gain": 1.0})]
    done = []
    for run in plan:
        made = simulate(rig, run, start_angle=0.3 * rig.angle_per_count, accel_offset=3.0)
        noisy = np.floor(made.accel + rng.standard_normal(len(run.t)) + 0.5)
        done.append(replace(run, command=made.command, encoder=made.encoder, accel=noisy))
    return done


def hidden_rig(rig: Rig, hold: tuple[str, ...], seed: int) -> Rig:
    """Every constant 30 % up or down."""
    rng = np.random.default_rng(seed)
    return rig.with_constants({path: value * rng.choice([0.7, 1.3]) for path, value in rig.constants().items()
                               if path not in hold})


def test_a_hidden_rig_is_found_again_from_thirty_percent_away_and_what_no_data_hold_is_said():
    rig = load_rig("sflr")
    hidden = hidden_rig(rig, SCALES, 1)
    result = fit(rig, runs_on(hidden), SCALES, starts=1)
    assert result.chi2_nominal > 50.0 and result.chi2 < 1.3
    truth = hidden.constants()
    for constant in result.constants:
        if constant.determined > 0.9:
            assert constant.value == pytest.approx(truth[constant.path], rel=0.12), constant.path
    sharp = {"beam.flexural_rigidity", "accelerometer.gain", "base.inertia"}
    for constant in result.constants:
        if constant.path in sharp:
            assert constant.value == pytest.approx(truth[constant.path], rel=0.02), constant.path
    assert result.rig.constants()["beam.length"] == truth["beam.length"]
    loose = {c.path for c in result.constants if c.determined < 0.5}
    assert "tip.inertia" in loose
    assert any("tip.inertia" in text and "do not determine" in text for text in result.warnings)
    assert any("tip.inertia" in direction.powers for direction in result.flat)
    assert not any(direction.always for direction in result.flat), "balance and ruler close every invisible one"
    assert ("motor.damping", "motor.gain") in {pair[:2] for pair in result.correlated()}
    text = result.table()
    assert "tip.inertia" in text and "held" in text and "warning:" in text


def test_intervals_hold_a_rig_drawn_from_the_stated_uncertainty():
    rig = load_rig("sflr")
    paths = [path for path in rig.constants() if path not in SCALES]
    logs = np.linalg.cholesky(rig.log_covariance(paths)) @ np.random.default_rng(4).standard_normal(len(paths))
    truth = {path: rig.constants()[path] * np.exp(log) for path, log in zip(paths, logs, strict=True)}
    result = fit(rig, runs_on(rig.with_constants(truth)), SCALES, starts=1)
    inside = [c.low <= truth[c.path] <= c.high for c in result.constants]
    width = [np.log(c.high / c.low) for c in result.constants if c.path == "beam.flexural_rigidity"]
    assert sum(inside) >= len(inside) - 2
    assert width[0] < 0.05, "narrow where the data speak"


@pytest.mark.parametrize("unit", [0, 1])
def test_the_units_of_torque_and_length_leave_every_reading_as_it_was(unit):
    rig = load_rig("sflr")
    constants = rig.constants()
    factor = dict(zip(constants, 1.4 ** powers(list(constants), unit), strict=True))
    scaled = rig.with_constants({path: value * factor[path] for path, value in constants.items()})
    for run in runs_on(rig):
        one, other = (simulate(r, run, rounding=False, start_angle=0.0) for r in (rig, scaled))
        np.testing.assert_allclose(other.encoder, one.encoder, atol=1e-5)
        np.testing.assert_allclose(other.accel, one.accel, atol=1e-5)


def test_default_hold_reports_the_length_that_no_data_show():
    rig = load_rig("sflr")
    result = fit(rig, runs_on(rig)[:2], starts=1)
    assert result.held == ("beam.mass_per_length",)
    assert {c.path for c in result.constants} | set(result.held) == set(rig.constants())
    assert result.rig.uncertainty == rig.uncertainty
    always = [direction for direction in result.flat if direction.always]
    assert len(always) == 1
    powers = always[0].powers
    assert powers["accelerometer.gain"] / powers["beam.length"] == pytest.approx(-1.0, abs=1e-6)
    assert powers["beam.flexural_rigidity"] / powers["beam.length"] == pytest.approx(4.0, abs=1e-6)
    assert "invisible to any data" in result.table()


def test_nothing_held_is_warned_of():
    rig = load_rig("sflr")
    result = fit(rig, runs_on(rig)[:1], hold=(), starts=1)
    assert any("common factor" in text and "motor.gain" in text for text in result.warnings)
    assert sum(direction.always for direction in result.flat) == 2


def test_frequency_domain_finds_the_modes_of_a_hidden_rig():
    rig = load_rig("sflr")
    hold = tuple(p for p in rig.constants() if p not in ("beam.flexural_rigidity", "accelerometer.gain", "motor.gain"))
    hidden = rig.with_constants({path: rig.constants()[path] * factor for path, factor in (
        ("beam.flexural_rigidity", 0.7), ("accelerometer.gain", 1.3), ("motor.gain", 0.75))})
    rng = np.random.default_rng(0)
    run = sent("noise", 80.0 * rng.standard_normal(12000).clip(-2, 2), {"kind": "open"})
    made = simulate(hidden, run, start_angle=0.0)
    result = fit(rig, [replace(run, encoder=made.encoder, accel=made.accel)], hold, domain="frequency", starts=1)
    for constant in result.constants:
        assert constant.value == pytest.approx(hidden.constants()[constant.path], rel=0.02), constant.path


def test_both_domains_together_find_what_either_finds():
    rig = load_rig("sflr")
    hold = tuple(p for p in rig.constants() if p not in ("beam.flexural_rigidity", "accelerometer.gain", "motor.gain"))
    hidden = rig.with_constants({path: rig.constants()[path] * factor for path, factor in (
        ("beam.flexural_rigidity", 0.9), ("accelerometer.gain", 1.1), ("motor.gain", 0.9))})
    run = sent("noise", 80.0 * np.random.default_rng(0).standard_normal(6000).clip(-2, 2), {"kind": "open"})
    made = simulate(hidden, run, start_angle=0.0)
    logged = [replace(run, encoder=made.encoder, accel=made.accel)]
    found = {domain: fit(rig, logged, hold, domain=domain, starts=1) for domain in ("time", "frequency", "both")}
    for result in found.values():
        for constant in result.constants:
            assert constant.value == pytest.approx(hidden.constants()[constant.path], rel=0.02), constant.path
    assert found["both"].chi2 not in (found["time"].chi2, found["frequency"].chi2)


def test_a_run_without_a_response_is_refused_in_the_frequency_domain_alone():
    rig = load_rig("sflr")
    short = runs_on(rig)[:1]
    with pytest.raises(WorkError, match="no run is long and rich enough for a fit in the frequency domain"):
        fit(rig, short, domain="frequency", starts=1)
    assert fit(rig, short, domain="both", starts=1).chi2 == pytest.approx(fit(rig, short, starts=1).chi2, rel=0.01)


def test_what_an_effect_of_the_rig_file_may_be_is_fitted_with_the_constants():
    friction = effect_class("coulomb_friction")
    rig = load_rig("sflr").with_effects([friction(at="motor", torque=0.05)])
    rig = rig.model_copy(update={"uncertainty": {**rig.uncertainty, "coulomb_friction.torque": 0.3}})
    hidden = rig.with_effects([friction(at="motor", torque=0.07)])
    result = fit(rig, runs_on(hidden), SCALES, starts=1)
    (torque,) = [c for c in result.constants if c.path == "coulomb_friction.torque"]
    assert torque.low < 0.07 < torque.high and torque.determined > 0.9
    assert result.rig.effects[0].torque == pytest.approx(torque.value)


def test_a_pendulum_is_fitted_wherever_its_encoder_was_zeroed_and_its_angle_is_told_in_radians():
    tilt = effect_class("gravity_tilt")
    axis = load_rig("sflr").model_copy(update=dict.fromkeys(("drive", "base", "clamp", "beam", "tip", "accelerometer")))
    rig = axis.with_effects([tilt(at="base", torque=0.4, angle=0.0)]).model_copy(update={"uncertainty": {
        "default": 0.2, "gravity_tilt.torque": 0.3, "gravity_tilt.angle": 0.05}})
    hidden = rig.with_effects([tilt(at="base", torque=0.5, angle=0.0)])
    run = sent("pulse", 100.0 * (np.arange(800) % 200 < 60), {"kind": "open"})
    zeros = -0.03, 0.02, 0.03
    made = [simulate(hidden, run, start_angle=-zero, zero=zero).encoder for zero in zeros]
    runs = [replace(run, name=f"zero {zero}", encoder=read, accel=None) for zero, read in zip(zeros, made, strict=True)]
    result = fit(rig, runs, starts=1)
    torque, angle = (next(c for c in result.constants if c.path == f"gravity_tilt.{name}")
                     for name in ("torque", "angle"))
    assert torque.low < 0.5 < torque.high and torque.determined > 0.9
    assert angle.low < 0.0 < angle.high and angle.high - angle.low == pytest.approx(2.0 * 1.96 * 0.05, rel=0.3)
    assert angle.determined < 0.5, "encoders that were zeroed anywhere do not say where down is"
    assert result.rig.effects[0].torque == pytest.approx(torque.value)
    assert result.rig.effects[0].angle == pytest.approx(angle.value)


def test_a_constant_that_is_exact_stays():
    rig = load_rig("sflr")
    rig = rig.model_copy(update={"uncertainty": {**rig.uncertainty, "beam.length": 0.0}})
    result = fit(rig, runs_on(hidden_rig(rig, SCALES, 1))[:2], starts=1)
    assert "beam.length" not in {c.path for c in result.constants}
    assert result.rig.beam.length == rig.beam.length and not any(direction.always for direction in result.flat)


def test_rigid_axis_is_fitted_without_a_beam():
    rig = load_rig("sflr").model_copy(update=dict.fromkeys(("drive", "base", "clamp", "beam", "tip", "accelerometer")))
    rig = rig.model_copy(update={"uncertainty": {"default": 0.2}})
    run = sent("pulse", 100.0 * (np.arange(800) % 200 < 60), {"kind": "open"})
    hidden = rig.with_constants({"motor.damping": rig.motor.damping * 1.3, "motor.gain": rig.motor.gain * 0.8})
    made = simulate(hidden, run, start_angle=0.0)
    result = fit(rig, [replace(run, encoder=made.encoder, accel=None)], starts=2)
    assert result.held == ("motor.inertia",) and result.agreeing == 2
    truth, found = hidden.constants(), result.rig.constants()
    for constant in result.constants:
        assert constant.low <= truth[constant.path] <= constant.high
    ratios = [constants["motor.gain"] / constants["motor.damping"] for constants in (found, truth)]
    assert ratios[0] == pytest.approx(ratios[1], rel=2e-3), "the speed that a command ends at"


@pytest.mark.parametrize(("change", "words"), [
    ({"hold": ("beam.mass",)}, "hold beam.mass: this rig has"), ({"domain": "laplace"}, "none of time, frequency"),
    ({"runs": []}, "at least one run")])
def test_wrong_use_is_named(change, words):
    rig = load_rig("sflr")
    arguments = {"runs": runs_on(rig)[:1], **change}
    with pytest.raises(UsageError, match=words):
        fit(rig, **arguments)


def test_a_run_at_another_rate_is_refused():
    rig = load_rig("sflr")
    run = runs_on(rig)[0]
    with pytest.raises(WorkError, match="pulse: sampled at 300 Hz, the rig at 500 Hz"):
        fit(rig, [replace(run, t=run.t * 5.0 / 3.0)])


def test_measured_step_is_fitted_better_than_nominal_and_the_misfit_is_named():
    rig = load_rig("sflr")
    result = fit(rig, [load_run(measured_log("p"))], starts=1)
    assert result.chi2 < 0.3 * result.chi2_nominal
    assert any("times the noise" in text for text in result.warnings)
