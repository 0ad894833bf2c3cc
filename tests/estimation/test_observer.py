"""Observers forget a wrong angle after their horizon, on rigs of every shape."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from station.estimation.filter import _solved, filter_of, steady_gain
from station.estimation.observer import (
    UNMODELLED,
    Observer,
    _corrected,
    _slowest,
    correction,
    noise_gain,
    observers,
    slopes,
    torque_gains,
)
from station.model.effects import Effect, effect_class
from station.model.simulate import build, initial_state
from station.model.stepper import advance, begin, sense, working_room
from station.rig import Encoder, Rig
from tests.truth import RIGID_AXIS, SERVO, SFLR, TWO_MASS

RIGS = {"axis": RIGID_AXIS, "two-mass": TWO_MASS, "sflr": SFLR, "servo": SERVO}
HORIZONS = (0.05, 0.5)
MOTION = np.stack([0.3 * np.sin(np.arange(256) / 7.0), 2.0 * np.cos(np.arange(256) / 7.0)], axis=1)
"""Angles, rad, and speeds, rad/s."""


def bare(shape: str) -> Rig:
    """The rig without effects, with the mesh of fits."""
    return Rig.model_validate(RIGS[shape]).with_effects([]).with_elements(8)


def errors_left(rig: Rig, horizon: float, noise: float, nominal: Rig | None = None) -> np.ndarray:
    """Encoder errors (n) of predictions of a rig at rest that begin a small angle away; the stepper, row by row."""
    (observer,) = observers(nominal or rig, noise, (horizon,))
    model, about = build(rig, 0.1, 1e-3), slopes(rig, MOTION)
    wrong, right = (initial_state(model, angle, 0.0) for angle in (1e-3, 0.0))
    (gain, at_motor, decay, _), work = correction(observer, model, about), working_room(model.plan)
    begin(model.plan, wrong)
    begin(model.plan, right)
    torque, found = 0.0, []
    for _ in range(math.ceil(12.0 * horizon / rig.period)):
        missed = sense(model.plan, right, 0.0, False)[0] - sense(model.plan, wrong, 0.0, False)[0]
        found.append(missed)
        wrong.z[:] += gain * missed
        torque = decay * (torque + at_motor * missed)
        advance(model.plan, wrong, 0.0, torque, work)
        advance(model.plan, right, 0.0, 0.0, work)
    return np.array(found)


@pytest.mark.parametrize("horizon", HORIZONS)
@pytest.mark.parametrize("shape", RIGS)
def test_a_wrong_angle_is_forgotten_after_the_horizon(shape: str, horizon: float) -> None:
    rig = bare(shape)
    errors = np.abs(errors_left(rig, horizon, 0.1))
    assert errors.sum() * rig.period / errors[0] == pytest.approx(horizon, rel=0.02)
    if (shape, horizon) != ("sflr", 0.05):          # there the arm rings on: no torque that quick damps its mode
        assert errors[-1] < 0.02 * errors[0]


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("shape", RIGS)
def test_the_quick_horizon_is_that_of_the_torque_that_models_lack(shape: str, noise: float) -> None:
    rig = bare(shape)
    quick, whole = observers(rig, noise)
    torque = math.exp(quick.log_size) / rig.amplifier.limit
    assert torque == pytest.approx(UNMODELLED, rel=0.1) and math.isinf(whole.horizon)   # an arm's has steps


@pytest.mark.parametrize("shape", RIGS)
def test_the_finer_an_encoder_the_quicker_a_torque_shows(shape: str) -> None:
    rig = bare(shape)
    found = [observers(rig.model_copy(update={"encoder": Encoder(counts_per_revolution=counts)}), 0.0)[0].horizon
             for counts in (512.0, 4096.0, 32768.0)]
    assert found[0] > found[1] > found[2] > 3.0 * rig.period


@pytest.mark.parametrize("counts", [2.0**16, 2.0**20, 2.0**24])
@pytest.mark.parametrize("shape", RIGS)
def test_however_fine_an_encoder_a_wrong_angle_is_forgotten_after_the_quick_horizon(shape: str, counts: float) -> None:
    """The torque that models lack may by then be so large that an observer that reckons with it rings."""
    rig = bare(shape).model_copy(update={"encoder": Encoder(counts_per_revolution=counts)})
    quick = observers(rig, 0.0)[0]
    errors = np.abs(errors_left(rig, quick.horizon, 0.0))
    assert errors.sum() * rig.period / errors[0] == pytest.approx(quick.horizon, rel=0.02)
    assert quick.log_size - math.log(rig.amplifier.limit) < math.log(UNMODELLED) + 0.1
    assert errors[-1] < 0.02 * errors[0]


@pytest.mark.parametrize("counts", [2.0**12, 2.0**20])
@pytest.mark.parametrize("shape", RIGS)
def test_the_commands_unit_does_not_change_an_observer(shape: str, counts: float) -> None:
    """Counts, volts or shares of one: the motor is the same."""
    rig = bare(shape).model_copy(update={"encoder": Encoder(counts_per_revolution=counts)})
    unit = rig.amplifier.limit
    other = rig.with_constants({"motor.gain": rig.motor.gain * unit}).model_copy(
        update={"amplifier": rig.amplifier.model_copy(update={"limit": 1.0})})
    one, two = (observers(r, 0.0)[0] for r in (rig, other))
    assert two.horizon == pytest.approx(one.horizon, rel=1e-6)
    assert two.log_size == pytest.approx(one.log_size - math.log(unit), abs=1e-4)


@pytest.mark.parametrize("shape", RIGS)
def test_what_noise_makes_of_predictions_is_known(shape: str) -> None:
    """A rig at rest that is read with noise; the stepper, row by row."""
    rig, drawn = bare(shape), np.random.default_rng(0).standard_normal(20_000)
    quick = observers(rig, 2.0)[0]
    model = build(rig, 0.1, 1e-3)
    state, (gain, at_motor, decay, _) = initial_state(model, 0.0, 0.0), correction(quick, model)
    work, torque, missed = working_room(model.plan), 0.0, []
    begin(model.plan, state)
    for noise in drawn.tolist():
        missed.append(noise - sense(model.plan, state, 0.0, False)[0])
        state.z[:] += gain * missed[-1]
        torque = decay * (torque + at_motor * missed[-1])
        advance(model.plan, state, 0.0, torque, work)
    expected = noise_gain(quick, model)
    assert expected > 1.0 and float(np.mean(np.square(missed))) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("shape", RIGS)
def test_what_one_wrong_reading_makes_of_the_torque_is_known(shape: str) -> None:
    """Squared and summed it is what white noise makes of it."""
    quick, model = observers(bare(shape), 2.0)[0], build(bare(shape), 0.1, 1e-3)
    state, (gain, at_motor, decay, _) = initial_state(model, 0.0, 0.0), correction(quick, model)
    work, torque, torques = working_room(model.plan), 0.0, []
    begin(model.plan, state)
    for row in range(math.ceil(12.0 * quick.horizon / model.rig.period)):
        missed = float(row == 0) - sense(model.plan, state, 0.0, False)[0]
        state.z[:] += gain * missed
        torque = decay * (torque + at_motor * missed)
        torques.append(torque)
        advance(model.plan, state, 0.0, torque, work)
    assert float(np.sum(np.square(torques))) == pytest.approx(torque_gains(quick, model)[1], rel=0.01)


@pytest.mark.parametrize("horizon", [0.03, 0.2])
@pytest.mark.parametrize("shape", RIGS)
def test_the_share_that_an_observer_shows_of_a_torque_that_stays_is_known(shape: str, horizon: float) -> None:
    """Some counts that act and that nobody told it of; the stepper, row by row."""
    rig = bare(shape)
    (observer,), model, acts = observers(rig, 0.1, (horizon,)), build(rig, 0.0, 1e-3), 7.0
    wrong, right = (initial_state(model, 0.0, 0.0) for _ in range(2))
    (gain, at_motor, decay, _), work = correction(observer, model), working_room(model.plan)
    begin(model.plan, wrong)
    begin(model.plan, right)
    torque = 0.0
    for _ in range(math.ceil(40.0 * max(horizon, 0.1) / rig.period)):
        missed = sense(model.plan, right, 0.0, False)[0] - sense(model.plan, wrong, 0.0, False)[0]
        wrong.z[:] += gain * missed
        torque = decay * (torque + at_motor * missed)
        advance(model.plan, wrong, 0.0, torque, work)
        advance(model.plan, right, 0.0, acts, work)
    share = torque_gains(observer, model)[0]
    assert 0.02 < share < 1.0 and torque / acts == pytest.approx(share, rel=0.02)


OTHER = [("two-mass", {"motor.inertia": 0.1}), ("servo", {"motor.damping": 20.0}), ("axis", {"motor.gain": 30.0}),
         ("sflr", {"drive.stiffness": 600.0}), ("sflr", {"drive.damping": 10.0}), ("sflr", {"motor.damping": 0.15}),
         ("sflr", {"motor.gain": 20.0, "motor.inertia": 20.0}), ("sflr", {"beam.length": 0.5}),
         ("sflr", {"base.inertia": 0.02})]


@pytest.mark.parametrize(("shape", "factors"), OTHER, ids=lambda x: x if isinstance(x, str) else "-".join(x))
def test_another_rig_forgets_as_fast_as_the_nominal_one(shape: str, factors: dict[str, float]) -> None:
    """Else a hypothesis would be predicted less far ahead than its rivals, and win by that."""
    nominal = bare(shape)
    rig = nominal.with_constants({path: nominal.constants()[path] * factor for path, factor in factors.items()})
    errors = np.abs(errors_left(rig, 0.05, 0.1, nominal))
    assert errors.sum() * rig.period / errors[0] == pytest.approx(0.05, rel=1e-3)


@pytest.mark.parametrize(("shape", "factors"), OTHER, ids=lambda x: x if isinstance(x, str) else "-".join(x))
def test_another_rig_with_a_fine_encoder_does_so_too(shape: str, factors: dict[str, float]) -> None:
    """Its quick horizon is three to six samples, about as short as an observer's memory can be."""
    nominal = bare(shape).model_copy(update={"encoder": Encoder(counts_per_revolution=2.0**20)})
    horizon = observers(nominal, 0.0)[0].horizon
    rig = nominal.with_constants({path: nominal.constants()[path] * factor for path, factor in factors.items()})
    errors = np.abs(errors_left(rig, horizon, 0.0, nominal))
    assert 3.0 < horizon / rig.period < 6.0
    assert errors.sum() * rig.period / errors[0] == pytest.approx(horizon, rel=0.01)


@pytest.mark.parametrize("gain", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("left", [0.02, 0.1, 0.3, 0.65])
def test_a_loose_joint_forgets_as_fast_in_any_unit_of_torque(left: float, gain: float) -> None:
    """With play a load hangs on a share of its spring: its memory is nearly flat over some sizes of the torque."""
    nominal = Rig.model_validate({
        "name": "loose", "sample_rate": 500.0, "amplifier": {"limit": 1000.0},
        "motor": {"inertia": 0.0022, "damping": 0.0053, "gain": 0.0008}, "drive": {"stiffness": 8.7, "damping": 0.011},
        "base": {"inertia": 0.0045}, "encoder": {"counts_per_revolution": 8192}})
    (observer, _), found = observers(nominal, 0.33), []
    for factor in (1.0, gain):
        model = build(nominal.with_constants({"motor.gain": factor * nominal.motor.gain}), 0.1, 1e-3)
        about = (("drive", (left - 1.0) * nominal.drive.stiffness),)
        at, kept = correction(observer, model, about), _corrected(observer, model.form)
        system = filter_of(model, observer.horizon, kept, about)
        gains = [*at.state[model.form.columns(kept)], at.torque]
        found.append([*at.state, factor * at.torque])
        state, left_over = system.first.copy(), 0.0
        for _ in range(math.ceil(12.0 * observer.horizon / nominal.period)):
            shown = float(system.h @ state)
            left_over += abs(shown) * nominal.period
            state = system.f @ (state - np.multiply(gains, shown))
        assert left_over == pytest.approx(observer.horizon, rel=1e-6)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-5, atol=1e-8 * np.abs(found[0]).max())


@pytest.mark.parametrize("elements", [8, 16, 13])
def test_another_mesh_is_corrected_alike(elements: int) -> None:
    """What a unit error moves, seen where all meshes have nodes: motor, base and clamp's rotation."""
    rig = bare("sflr")
    (observer,) = observers(rig, 0.1, (0.05,))
    one, other = (build(r, 0.0, 1e-3) for r in (rig, rig.with_elements(elements)))
    seen = [[m.assembly.motor, m.assembly.base, m.assembly.root] for m in (one, other)]
    moved = [(m.form.basis @ correction(observer, m).state)[at] for m, at in zip((one, other), seen, strict=True)]
    assert moved[1] == pytest.approx(moved[0], rel=1e-3)


@pytest.mark.parametrize("log_size", [-3.0, 2.0])
@pytest.mark.parametrize("shape", RIGS)
def test_the_gain_is_that_of_scipys_riccati_equation(shape: str, log_size: float) -> None:
    """The steady one, after a million rows."""
    model, horizon, variance = build(bare(shape), 0.1, 1e-3), 0.05, 0.1
    system = filter_of(model, horizon, _slowest(model, horizon))
    noise = math.exp(2.0 * log_size) * (1.0 - system.decay**2) * np.outer(system.enters, system.enters)
    p = solve_discrete_are(system.f.T, system.h[:, None], noise, [[variance]])
    expected = p @ system.h / (system.h @ p @ system.h + variance)
    gain = steady_gain(system, variance, log_size, 20)
    np.testing.assert_allclose(gain, expected, atol=1e-10 * np.abs(expected).max())


def test_elimination_chooses_its_pivots() -> None:
    """Not so where the first one is 0."""
    rng = np.random.default_rng(3)
    for size in (1, 2, 7, 13):
        a, b = rng.standard_normal((size, size)), rng.standard_normal((size, size))
        a[0, 0] = 0.0 if size > 1 else 2.0
        np.testing.assert_allclose(_solved(a, b), np.linalg.solve(a, b), rtol=1e-9)
    assert not np.isfinite(_solved(np.ones((2, 2)), np.eye(2))).any()


def test_a_rig_that_has_no_observer_is_not_finite() -> None:
    model = build(bare("axis"), 0.1, 1e-3)
    broken = replace(model, plan=model.plan._replace(base_angle=np.full_like(model.plan.base_angle, np.nan)))
    assert not np.isfinite(correction(Observer(0.05, blocks=1), broken).torque)


def test_an_infinite_horizon_corrects_nothing() -> None:
    (observer,) = observers(bare("sflr"), 0.1, (math.inf,))
    found = correction(observer, build(bare("sflr")))
    assert not found.state.any() and found.torque == 0.0


@pytest.mark.parametrize("shape", RIGS)
def test_a_shorter_horizon_corrects_more(shape: str) -> None:
    model = build(bare(shape))
    quick, slow, whole = (correction(o, model) for o in observers(bare(shape), 0.1, (0.05, 0.5, math.inf)))
    assert quick.torque > slow.torque > whole.torque == 0.0
    assert quick.decay < slow.decay < 1.0


def test_effects_of_the_rig_do_not_change_its_observers() -> None:
    friction = effect_class("coulomb_friction")(at="motor", torque=0.01)
    rigs = bare("sflr"), bare("sflr").with_effects([friction])
    for one, other in zip(*(observers(rig, 0.1, HORIZONS) for rig in rigs), strict=True):
        assert one == other
        first, second = (correction(one, build(rig, 0.0)) for rig in rigs)
        assert second.state == pytest.approx(first.state, rel=1e-9) and second.torque == pytest.approx(first.torque)


def one(name: str, at: str, **sizes: float) -> Effect:
    return effect_class(name)(at=at, **sizes)


@pytest.mark.parametrize(("effect", "slope"), [
    (one("sublinear_drag", "motor", coefficient=0.02, speed=1e3), -0.02),
    (one("sublinear_drag", "motor", coefficient=0.02, speed=2.0),
     -0.02 * np.mean((1.0 + np.abs(MOTION[:, 1]) / 2.0) ** -2)),
    (one("quadratic_drag", "base", coefficient=0.01), -0.02 * np.mean(np.abs(MOTION[:, 1])))])
def test_drags_have_slopes_where_a_rig_moves(effect: Effect, slope: float) -> None:
    assert slopes(bare("sflr").with_effects([effect]), MOTION) == ((effect.at, pytest.approx(slope, rel=0.005)),)
    assert [part for part, _ in slopes(bare("axis").with_effects([effect]), MOTION)] == ["motor"]
    assert slopes(bare("sflr").with_effects([effect]), np.zeros((0, 2))) == ()


@pytest.mark.parametrize("effect", [
    one("coulomb_friction", "motor", torque=0.01), one("cable_spring", "base", stiffness=0.3, rest=0.2),
    one("torque_ripple", "motor", amplitude=0.05, cycles=200.0, phase=0.4),
    one("gravity_tilt", "base", torque=0.5, angle=0.0)], ids=lambda effect: effect.name)
def test_what_acts_alike_at_all_speeds_has_no_slope(effect: Effect) -> None:
    assert slopes(bare("sflr").with_effects([effect]), MOTION) == ()


@pytest.mark.parametrize("shape", RIGS)
def test_a_viscous_drag_has_the_observer_of_the_damping_that_it_is(shape: str) -> None:
    """Or what was moved from the one to the other would be predicted better, whatever acts."""
    damped = bare(shape)
    damping = damped.motor.damping
    drag = one("sublinear_drag", "motor", coefficient=0.9 * damping, speed=1e3)
    moved = damped.with_constants({"motor.damping": 0.1 * damping}).with_effects([drag])
    (observer,) = observers(damped, 0.1, (0.05,))
    motion, found = MOTION * [1.0, 1e-3], []
    for rig in (damped, moved):
        model = build(rig, 0.0, 1e-3)
        at = correction(observer, model, slopes(rig, motion))
        found.append([*(model.form.basis @ at.state), at.torque])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-3, atol=1e-4 * np.abs(found[0]).max())
    without = correction(observer, build(moved, 0.0, 1e-3))
    assert abs(without.torque / found[0][-1] - 1.0) > 0.01, "by the linear part alone it is another"


@pytest.mark.parametrize(("shape", "joint"), [("two-mass", "drive"), ("sflr", "drive"), ("sflr", "clamp")])
def test_a_joint_with_a_spring_of_another_law_has_the_observer_of_the_stiffness_that_comes_nearest(
        shape: str, joint: str) -> None:
    """Or a spring that is softer in the middle would be predicted better than the play that it stands in for."""
    plain, torques = bare(shape), 0.3 * np.sin(np.arange(256) / 7.0)
    stiffness = getattr(plain, joint).stiffness
    cubic = 2.0 * stiffness**3 / float(np.mean(torques**2))
    sprung = plain.with_effects([one("hardening_spring", joint, cubic=cubic)])
    (found,) = slopes(sprung, np.zeros((0, 2)), {joint: torques})
    assert found[0] == joint and found[1] > 0.1 * stiffness
    stiffer = plain.with_constants({f"{joint}.stiffness": stiffness + found[1]})
    (observer,) = observers(plain, 0.1, (0.05,))
    at = []
    for rig, about in ((stiffer, ()), (sprung, (found,)), (sprung, ())):
        model = build(rig, 0.0, 1e-3)
        gain = correction(observer, model, about)
        at.append([*(model.form.basis @ gain.state)[[model.assembly.motor, model.assembly.base]], gain.torque])
    with_it, without = (np.abs(np.array(gain) / at[0] - 1.0).max() for gain in at[1:])
    assert with_it < 0.02 and with_it < 0.2 * without, "by the linear part alone it is another"
    assert slopes(sprung, np.zeros((0, 2)), {}) == ()


@pytest.mark.parametrize("horizon", HORIZONS)
@pytest.mark.parametrize("shape", RIGS)
def test_with_drag_an_angle_is_forgotten_after_the_horizon_too(shape: str, horizon: float) -> None:
    rig = bare(shape)
    rig = rig.with_effects([one("sublinear_drag", "motor", coefficient=2.0 * rig.motor.damping, speed=1e3)])
    errors = np.abs(errors_left(rig, horizon, 0.1, bare(shape)))
    assert errors.sum() * rig.period / errors[0] == pytest.approx(horizon, rel=0.005)


def test_a_noisier_encoder_does_not_change_how_long_an_error_is_remembered() -> None:
    rig = bare("axis")
    for noise in (0.0, 1.0):
        errors = np.abs(errors_left(rig, 0.05, noise))
        assert errors.sum() * rig.period / errors[0] == pytest.approx(0.05, rel=0.02)
