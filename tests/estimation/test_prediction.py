"""Predictions: the simulation where nothing is corrected, and closer to the measured the shorter they look ahead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from station.estimation.dataset import dataset
from station.estimation.observer import Observer, observers
from station.estimation.prediction import SEARCH, predict_run
from station.model.effects import effect_class
from station.model.simulate import Model, build, simulate, simulate_model
from station.model.units import powers
from station.rig import Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.cli.conftest import step_run
from tests.estimation.made import AXIS, run_of
from tests.truth import SFLR, TWO_MASS, innovations


def predict(model: Model, watched: Sequence[Observer], run: Run, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a run that begins at rest."""
    data = dataset(model.rig, [run])
    at_rest = replace(data.records[0], finding=np.zeros(len(run), dtype=bool))
    return predict_run(replace(data, records=(at_rest,)), model, watched, 0, own)


def begun(angle: float, offset: float = 0.0) -> np.ndarray:
    """What a run has of its own: where it begins."""
    return np.array([angle, offset, 0.0, 0.0])


@pytest.mark.parametrize("controller", ["open", "p2"])
def test_without_corrections_a_prediction_is_the_simulation_driven_by_the_command(controller: str) -> None:
    friction = effect_class("coulomb_friction")(at="motor", torque=0.01)
    model = build(AXIS.with_effects([friction]), *SEARCH[:2])
    run = run_of(AXIS, 60.0, controller, "x")
    driven = run.metadata.model_copy(update={"controller": {"kind": "open"}, "command_row": 0})
    made = simulate_model(model, type(run)("x", run.t, run.command, run.command, run.encoder, None, driven),
                          rounding=False, start_angle=0.02)
    watched = observers(AXIS, 0.1, (math.inf,))
    found, torque = predict(model, watched, run, begun(0.02))
    np.testing.assert_allclose(found[0, 0], made.encoder, atol=1e-9)
    assert not torque.any()


def test_a_wrong_gain_matters_less_the_shorter_a_prediction_looks_ahead() -> None:
    run = run_of(AXIS, 60.0, "open", "x")
    wrong = build(AXIS.with_constants({"motor.gain": 1.2 * AXIS.motor.gain}), *SEARCH[:2])
    found, _ = predict(wrong, observers(AXIS, 0.1, (0.02, 0.1, 0.5, math.inf)), run, begun(0.0))
    errors = np.sqrt(np.mean((run.encoder - found[:, 0]) ** 2, axis=1)).tolist()
    assert errors == sorted(errors) and errors[0] < 0.2 * errors[-1]


def test_a_right_model_misses_no_more_than_rounding_at_any_horizon() -> None:
    run = run_of(AXIS, 60.0, "p2", "x")
    model = build(AXIS, *SEARCH[:2])
    found, _ = predict(model, observers(AXIS, 0.0), run, begun(0.0))
    assert np.abs(run.encoder - found[:, 0]).max() < 1.0
    assert np.std(run.encoder - found[:, 0], axis=1).max() < 0.4


@pytest.mark.parametrize("unit", ["torque", "length", "time"])
@pytest.mark.parametrize("rig", [load_rig("sflr").with_elements(8), AXIS], ids=lambda rig: rig.name)
def test_a_rig_in_other_units_predicts_the_same(rig: Rig, unit: str) -> None:
    """Neither what a sample corrects nor a horizon must hang on what no output shows, or causes win by what that does:
    a unit of torque, of length, or, with a clock that is off, of time."""
    ratio, paths = 1.3, list(rig.constants())
    scaled = {path: rig.constants()[path] * ratio**power for path, power in
              zip(paths, powers(paths, ("torque", "length", "time").index(unit)).tolist(), strict=True)}
    clock = [effect_class("clock_scale")(at="clock", ratio=ratio)] if unit == "time" else []
    other = rig.with_constants(scaled).with_effects(clock)
    run = run_of(rig.with_constants({"motor.gain": 1.2 * rig.motor.gain}), 60.0, "p2", "x")
    watched = observers(rig, 0.1)
    (plain, torque), (found, again) = (predict(build(r, 0.0), watched, run, begun(0.0)) for r in (rig, other))
    assert np.abs(torque[0]).max() > 1.0
    np.testing.assert_allclose(again, torque, atol=1e-6)
    np.testing.assert_allclose(found, plain, atol=1e-6)


@pytest.mark.parametrize("phase", [0.0, 0.7, math.pi])
def test_an_encoder_of_another_slope_is_watched_by_as_quick_an_observer(phase: float) -> None:
    """Where it reads 10 % more or less per angle an error of a count is another angle, and is corrected as that."""
    late = AXIS.with_constants({"motor.gain": 1.2 * AXIS.motor.gain})
    watched, run = observers(AXIS, 0.1), run_of(late, 60.0, "p2", "x")
    off = effect_class("encoder_eccentricity")(at="encoder", amplitude=0.1 / AXIS.angle_per_count, phase=phase)
    read = run.encoder + off.amplitude * np.sin(run.encoder * AXIS.angle_per_count + phase)
    _, torque = predict(build(AXIS.with_effects([off]), 0.0), watched, replace(run, encoder=read),
                        begun(float(read[0] * AXIS.angle_per_count)))
    _, missing = predict(build(AXIS, 0.0), watched, run, begun(float(run.encoder[0] * AXIS.angle_per_count)))
    assert np.abs(missing[0]).max() > 1.0
    np.testing.assert_allclose(torque[0], missing[0], atol=0.02 * np.abs(missing[0]).max())


@pytest.mark.parametrize("late", [0.5, 2.0, 3.5])
def test_a_late_encoder_and_a_late_command_predict_the_same(late: float) -> None:
    """On an axis that only its encoder watches nothing tells the two apart, at any horizon."""
    delays = {"encoder_delay": "encoder", "input_delay": "amplifier"}
    other = AXIS.with_constants({"motor.gain": 1.2 * AXIS.motor.gain})
    watched, run = observers(AXIS, 0.1), run_of(other, 60.0, "p2", "x")
    models = [build(AXIS.with_effects([effect_class(name)(at=at, time=late * AXIS.period)]), 0.0, 1e-3)
              for name, at in delays.items()]
    (encoder, _), (command, _) = (predict(model, watched, run, begun(0.0)) for model in models)
    assert np.abs(encoder[0, 0] - encoder[1, 0]).max() > 1.0
    np.testing.assert_allclose(encoder[:, 0], command[:, 0], atol=1e-3)


def test_of_a_run_that_begins_in_motion_the_state_is_found_before_anything_counts() -> None:
    rig = load_rig("sflr")
    whole = step_run(rows=1200)
    moving = whole.slice(int(np.argmax(np.abs(np.diff(whole.encoder)) > 1.0)) + 20)
    data = dataset(rig, [moving])
    model = build(data.rig, *SEARCH[:2])
    watched = observers(data.rig, data.noise[0], (math.inf,))
    found, torque = predict_run(data, model, watched, 0, data.own[0])
    rest = predict(model, watched, moving, data.own[0])[0]
    rows = ~data.records[0].finding
    error, at_rest = (np.sqrt(np.mean((moving.encoder[rows] - y[0, 0, rows]) ** 2)) for y in (found, rest))
    assert data.records[0].in_motion and not torque[0, rows].any()
    assert error < 1.0 and at_rest > 5.0 * error


def test_a_quick_observer_finds_the_state_by_itself_where_the_rig_is_wrong() -> None:
    """Taken over from the slow one that finds it for whole runs, a wrong speed was a blow that outweighed the run."""
    finer = 256.0
    rig = AXIS.with_constants({"encoder.counts_per_revolution": finer * AXIS.encoder.counts_per_revolution})
    rubbing = rig.with_effects([effect_class("coulomb_friction")(at="motor", torque=0.3)])
    t = np.arange(round(4.0 * rig.sample_rate)) / rig.sample_rate
    reference = finer * 200.0 * np.sin(2.0 * np.pi * 0.8 * t)
    zero = np.zeros(len(t))
    asked = Run("x", t, reference, zero, zero, None, RunMetadata(controller={"kind": "p", "gain": 2.0 / finer}))
    made = simulate(rubbing, asked)
    cut = replace(asked, command=made.command, encoder=made.encoder).slice(round(0.4 * rig.sample_rate))
    data = dataset(rig, [replace(cut, t=cut.t - cut.t[0])])
    assert data.records[0].in_motion
    watched = observers(data.rig, data.noise[0])
    found = predict_run(data, build(data.rig, *SEARCH[:2]), watched, 0, data.own[0])[0]
    first = int(np.argmin(data.records[0].finding))
    errors = np.abs(data.records[0].measured[0] - found[0, 0])
    assert errors[first: first + 50].max() <= 1.5 * errors[first + 50:].max()


def test_a_known_torque_is_found_by_the_observer() -> None:
    """A constant torque at the motor, unknown to the model, is what the slow observer ends with, in counts."""
    bias = effect_class("command_bias")(at="amplifier", offset=6.0)
    run = run_of(AXIS.with_effects([bias]), 60.0, "p2", "x")
    _, torque = predict(build(AXIS, *SEARCH[:2]), observers(AXIS, 0.0, (0.05,)), run, begun(0.0))
    assert 0.0 < torque[0, len(run) // 4:].mean() < 6.5


def test_without_disturbances_the_plain_filter_of_a_perfect_arm_predicts_the_same() -> None:
    """The independent dense filter with next to no disturbance is the simulation; it corrects the start alone."""
    rig = load_rig("sflr").with_elements(16)
    run = run_of(rig, 60.0, "open", "x", 0.8)
    found, _ = predict(build(rig, 0.0, 2e-4), observers(rig, 0.0, (math.inf,)), run, begun(0.0))
    plain = innovations.innovations(SFLR, run.command, run.encoder[:, None], start_spread=1e-9)
    np.testing.assert_allclose(found[0, 0], run.encoder - plain.errors[:, 0], atol=0.05)


def test_a_play_is_predicted_better_by_an_observer_that_knows_of_it() -> None:
    """Of two masses that disturbances drive besides; or what stands in for the play would win."""
    rig = Rig.model_validate({**{key: table for key, table in TWO_MASS.items() if key != "uncertainty"},
                              "drive": {"stiffness": 2.0, "damping": 0.01}})
    rig = rig.with_effects([effect_class("backlash")(at="drive", gap=0.03)])
    t, random = np.arange(3000) / rig.sample_rate, np.random.default_rng(5)
    command = 60.0 * np.sign(np.sin(2.0 * math.pi * 0.7 * t)) * (t > 0.1)
    disturbed = command + 6.0 * np.convolve(random.standard_normal(len(t)), np.ones(50) / math.sqrt(50.0), "same")
    meta = RunMetadata(controller={"kind": "open"})
    made = simulate(rig, Run("x", t, command, disturbed, 0.0 * t, None, meta))
    data = dataset(rig.with_effects([]), [Run("x", t, command, command, made.encoder, None, meta)])
    watched, own = observers(data.rig, data.noise[0])[:1], data.own[0]
    errors = []
    for carried in (data.carried, {}):
        predicted, _ = predict_run(replace(data, carried=carried), build(rig, *SEARCH[:2]), watched, 0, own)
        errors.append(float(np.mean((data.records[0].measured[0] - predicted[0, 0]) ** 2)))
    assert errors[0] < 0.9 * errors[1]
