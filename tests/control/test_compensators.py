"""Compensators against their closed forms, another library's Tustin, and loops worked out by hand."""

import math

import control
import numpy as np
import pytest

from station.control.compensators import Compensator, commanded, tustin_lead
from station.errors import UsageError
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.run import Run, RunMetadata
from tests.truth import CONTROLLERS, RIGID_AXIS, Truth

RATE, LIMIT = 500.0, 200.0
PID = {"kind": "pid", "gain": 1.5, "integral": 0.8, "derivative": 0.05, "filter": 0.02}
CASCADE = {"kind": "cascade", "position_gain": 6.0, "speed_gain": 0.25}


def made(spec: dict, limit: float = LIMIT) -> Compensator:
    return Compensator.from_spec(spec, RATE, limit)


def outputs(spec: dict, errors: np.ndarray, limit: float = 1e9) -> np.ndarray:
    """Commands (n) for a row of errors, the encoder at rest at 0."""
    compensator = made(spec, limit)
    return np.array([compensator.step(float(e), 0.0, 0.0) for e in errors])


@pytest.mark.parametrize("terms", [{}, {"integral": 0.0}, {"derivative": 0.0, "filter": 0.0},
                                   {"integral": 0.0, "derivative": 0.0}, {"gain": -1.5}], ids=str)
def test_pid_answers_a_step_by_the_closed_form_of_its_terms_by_tustin(terms):
    """The trapezoids under a step of 1 add (2 k + 1)/(2 f); the filtered derivative decays by its pole."""
    spec = PID | terms
    k, slow = np.arange(400), 2.0 * RATE * spec["filter"]
    wanted = spec["gain"] * (1.0 + spec["integral"] * (2 * k + 1) / (2.0 * RATE) + spec["derivative"] * 2.0 * RATE
                             / (slow + 1.0) * ((slow - 1.0) / (slow + 1.0)) ** k)
    np.testing.assert_allclose(outputs(spec, np.ones(400)), wanted, rtol=1e-10)


def test_pid_and_lead_are_sampled_as_another_library_does():
    s = control.tf("s")
    pid = control.sample_system(1.5 * (1 + 0.8 / s + 0.05 * s / (0.02 * s + 1)), 1.0 / RATE, method="tustin")
    lead = control.sample_system(20.0 * (s + 31.0) / (s + 125.0), 1.0 / RATE, method="tustin")
    z = np.exp(1j * np.geomspace(1e-3, 3.0, 40))
    for wanted, (num, den) in ((pid, (made(PID).numerator, made(PID).denominator)),
                               (lead, tustin_lead(20.0, 31.0, 125.0, RATE))):
        assert den[0] == 1.0 and num.size == den.size
        np.testing.assert_allclose(np.polyval(num, z) / np.polyval(den, z), wanted(z), rtol=1e-8)


def test_a_term_of_a_pid_that_is_0_adds_no_state():
    sizes = [made(PID | terms).denominator.size for terms in
             ({}, {"integral": 0.0}, {"derivative": 0.0}, {"integral": 0.0, "derivative": 0.0})]
    assert sizes == [3, 2, 2, 1]


def test_the_integral_stops_at_the_limit():
    """The recursion runs on the limited output: after 2 s against the limit the command leaves it at once."""
    errors = np.concatenate([np.full(1000, 100.0), np.full(50, -1.0)])
    held = outputs({"kind": "pid", "gain": 1.0, "integral": 5.0, "derivative": 0.0, "filter": 0.0}, errors, limit=120.0)
    assert held[999] == 120.0 and held[1000] < 25.0


def test_cascade_takes_off_the_speed_by_backward_difference_and_begins_without_a_kick():
    compensator, angles = made(CASCADE, 1e9), np.array([30.0, 30.0, 31.0, 33.0, 32.0])
    found = [compensator.step(50.0, angle, 0.0) for angle in angles]
    speeds = np.array([0.0, 0.0, 1.0, 2.0, -1.0]) * RATE
    np.testing.assert_allclose(found, 0.25 * (6.0 * (50.0 - angles) - speeds), rtol=1e-12)
    compensator.reset()
    assert compensator.step(50.0, 10.0, 0.0) == pytest.approx(0.25 * 6.0 * 40.0)


def test_cascade_on_an_axis_is_the_second_order_loop_of_its_closed_form():
    """J y'' + (c + g s) y' + g s p y = g s p r, with counts for angles: at 20 kHz the hold hardly matters."""
    table = RIGID_AXIS | {"sample_rate": 20000.0}
    rig = Rig.model_validate(table)
    per = 1.0 / rig.angle_per_count
    rows, amplitude = 16000, 40.0
    t, zero = np.arange(rows) / 20000.0, np.zeros(rows)
    run = Run("step", t, np.full(rows, amplitude), zero, zero, None, RunMetadata(controller=CASCADE))
    found = simulate(rig, run, rounding=False, start_angle=0.0)
    motor = RIGID_AXIS["motor"]
    a = (motor["damping"] + motor["gain"] * per * 0.25) / motor["inertia"]
    b = motor["gain"] * per * 0.25 * 6.0 / motor["inertia"]
    fast, slow = (-0.5 * a - math.sqrt(0.25 * a * a - b), -0.5 * a + math.sqrt(0.25 * a * a - b))
    wanted = amplitude * (1.0 + (slow * np.exp(fast * t) - fast * np.exp(slow * t)) / (fast - slow))
    assert np.abs(found.command).max() < LIMIT
    np.testing.assert_allclose(found.encoder, wanted, atol=0.02)


def test_filter_is_its_difference_equation():
    numerator, denominator = [3.0, -1.0], [2.0, -1.0, 0.5]
    rng, v = np.random.default_rng(1), np.zeros(60)
    errors = rng.normal(size=60)
    for i in range(60):
        past = [(errors[i - k], v[i - k]) if i >= k else (0.0, 0.0) for k in (1, 2)]
        v[i] = (3.0 * past[0][0] - past[1][0] + past[0][1] - 0.5 * past[1][1]) / 2.0
    spec = {"kind": "filter", "numerator": numerator, "denominator": denominator}
    np.testing.assert_allclose(outputs(spec, errors), v, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("kind", sorted(set(CONTROLLERS) - {"open", "lead_accel"}))
def test_every_closed_loop_is_that_of_the_independent_generator(kind):
    """From a starting angle, against the limit and with rounding: the same whole counts."""
    reference = np.where(np.arange(700) < 50, 0.0, 90.0)
    wanted = Truth(RIGID_AXIS).run(reference, CONTROLLERS[kind], start_angle=0.05)
    zero = np.zeros(700)
    run = Run(kind, np.arange(700) / RATE, reference, zero, zero, None,
              RunMetadata(controller=CONTROLLERS[kind], command_row=-1))
    found = simulate(Rig.model_validate(RIGID_AXIS), run, start_angle=0.05)
    np.testing.assert_array_equal(found.command, wanted.command)
    np.testing.assert_array_equal(found.encoder, wanted.encoder)
    assert np.ptp(found.encoder) > 60.0


@pytest.mark.parametrize(("spec", "words"), [
    ({"kind": "pid", "gain": 1.0}, "controller.integral, controller.derivative, controller.filter: missing"),
    (PID | {"filter": 0.0}, "controller.filter: a time constant above 0"),
    (PID | {"derivative": 0.0, "filter": -0.1}, "controller.filter: a time constant above 0"),
    (PID | {"gain": [1.0, 2.0]}, "controller.gain: one number"),
    (PID | {"windup": 1.0}, "controller.windup: unknown key"),
    ({"kind": "p", "gian": 1.0}, "controller.gian: unknown key for kind 'p'; controller.gain: missing .kind"),
    ({"kind": "p", "gain": "2.0"}, "controller.gain: a number or a list of numbers is wanted, not '2.0'"),
    ({"kind": "p", "gain": True}, "controller.gain: a number or a list of numbers is wanted, not True"),
    ({"kind": "p", "gain": [[1.0], [1.0, 2.0]]}, "controller.gain: a number or a list"),
    ({"kind": "p", "gain": 2.0, "accel_zero": "much"}, "controller.accel_zero: a number"),
    ({"kind": "p", "gain": 2.0, "rounding": "no"}, "controller.rounding: true or false is wanted, not 'no'"),
    ({"kind": "cascade", "position_gain": 1.0}, "controller.speed_gain: missing"),
    ({"kind": "filter", "numerator": [1.0, 2.0], "denominator": [1.0]}, "controller.denominator: must begin"),
    ({"kind": "filter", "numerator": [1.0], "denominator": [0.0, 1.0]}, "controller.denominator: must begin"),
    ({"kind": "filter", "numerator": "ab", "denominator": [1.0]}, "controller.numerator: a number or a list"),
    ({"kind": "pd"}, "controller.kind: 'pd' is none of open, p, lead"),
    ({"kind": "unknown"}, "controller.kind: unknown, so that no command can be worked out"),
])
def test_a_controller_that_cannot_be_run_is_refused_with_its_key(spec, words):
    with pytest.raises(UsageError, match=words) as caught:
        made(spec)
    assert "\n" not in str(caught.value)


def test_commands_are_taken_as_logged_where_the_loop_is_open_or_not_known():
    assert [commanded({"kind": kind}) for kind in ("open", "unknown", "p", "pid")] == [True, True, False, False]
