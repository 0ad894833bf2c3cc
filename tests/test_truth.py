"""The truth generator held against closed forms, other integrators and the measured logs."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, toeplitz
from scipy.optimize import brentq
from scipy.signal import cont2discrete, lsim

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests import truth as tr
from tests.truth import disturbance
from tests.truth.cases import _weighted as weighted
from tests.truth.cases import multisine_test, prbs_test
from tests.truth.disturbance import Pushes, World, covariances, draw_pushes, draw_world, gauss_markov
from tests.truth.disturbance import _carried as carried
from tests.truth.disturbance import _shocks as shocks
from tests.truth.innovations import Coloured, innovations
from tests.truth.plant import ELEMENTS, beam_matrices, linear_system, mechanics
from tests.truth.rigs import own_sigma, with_constants
from tests.truth.simulate import compensator

OPEN = tr.CONTROLLERS["open"]
COUNT = 2 * math.pi / 1024
SHAFT = with_constants(
    tr.TWO_MASS,
    {"motor.damping": 0.1, "motor.gain": 0.01, "drive.stiffness": 2.0, "drive.damping": 0.005},
)


def axis(**motor: float) -> tr.RigDict:
    return with_constants(tr.RIGID_AXIS, {f"motor.{k}": v for k, v in motor.items()})


def effect(name: str, at: str, **parameters: float) -> tr.Effect:
    return {"effect": name, "at": at, **parameters}


def held(*pieces: tuple[int, float]) -> np.ndarray:
    return np.concatenate([np.full(n, v, float) for n, v in pieces])


def run_exact(rig: tr.RigDict, effects, reference, controller=OPEN, step: float = 1e-4, **keys) -> tr.Output:
    return tr.Truth(rig, effects, step).run(np.asarray(reference, float), controller, rounding=False, **keys)


def angle(out: tr.Output) -> np.ndarray:
    """Base angle at the ticks, rad."""
    return out.trace[:, 2]


def speed(out: tr.Output) -> np.ndarray:
    return out.trace[:, 3]


# --- independence -------------------------------------------------------------------------------------------


def test_the_generator_loads_none_of_what_it_judges():
    code = (
        "import json, sys; import tests.truth\nprint(json.dumps([m for m in sys.modules if m.startswith('station.')]))"
    )
    root = Path(__file__).parents[1]
    out = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    loaded = json.loads(out.stdout)
    assert "station.runs.run" in loaded
    assert not [m for m in loaded if m.startswith(("station.model", "station.control", "station.diagnose"))]


# --- the linear rig -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("tip", [0.0, 0.00612610])
def test_beam_frequencies_are_the_closed_form(tip):
    """Clamped-free: 1 + cos x cosh x + (m / mu L) x (cos x sinh x - sin x cosh x) = 0, w = x^2 sqrt(EI / mu
    L^4)."""
    mu, length, rigidity = 0.13664, 0.413544, 0.21
    mass, stiffness = beam_matrices(mu, length, rigidity, ELEMENTS, tip, 0.0)
    w = np.sqrt(eigh(stiffness[2:, 2:], mass[2:, 2:], eigvals_only=True))[:4]

    def characteristic(x: float) -> float:
        ratio = tip / (mu * length)
        bend = math.cos(x) * math.sinh(x) - math.sin(x) * math.cosh(x)
        return (1 + math.cos(x) * math.cosh(x) + ratio * x * bend) / math.cosh(x)

    grid = np.linspace(0.5, 12.0, 400)
    values = [characteristic(x) for x in grid]
    roots = [
        brentq(characteristic, a, b)
        for a, b, u, v in zip(grid, grid[1:], values, values[1:], strict=False)
        if u * v < 0
    ]
    closed = np.array(roots[:4]) ** 2 * math.sqrt(rigidity / (mu * length**4))
    assert w == pytest.approx(closed, rel=2e-4)


def test_unit_rig_has_its_first_mode_at_2_84_hz():
    system = linear_system(mechanics(tr.SFLR_UNIT), 1.0)
    swinging = [p for p in np.linalg.eigvals(system.a) if p.imag > 1e-6]
    assert min(abs(p) for p in swinging) / (2 * math.pi) == pytest.approx(2.84, abs=0.005)


def test_unit_rig_peaks_at_128_counts_in_the_pulse_test():
    command = held((20, 0), (50, 100), (630, 0), (50, -100), (250, 0))
    assert tr.Truth(tr.SFLR_UNIT).run(command, OPEN).encoder.max() == 128


def test_linear_open_loop_is_the_zero_order_hold_of_the_same_matrices():
    rng = np.random.default_rng(1)
    command = np.repeat(rng.uniform(-100, 100, 60), 5)
    out = run_exact(tr.SFLR, [], command)
    s = linear_system(mechanics(tr.SFLR), tr.SFLR["motor"]["gain"])
    a, b, *_ = cont2discrete((s.a, s.b[:, 6:], np.eye(len(s.a)), np.zeros((len(s.a), 1))), 0.002)
    z, angles, accels = np.zeros(len(s.a)), [], []
    for c in command:
        angles.append(s.c_encoder @ z)
        accels.append(s.c_acc @ z)
        z = a @ z + b[:, 0] * c
    assert out.encoder * COUNT == pytest.approx(np.array(angles), abs=1e-9)
    assert out.accel == pytest.approx(tr.SFLR["accelerometer"]["gain"] * np.array(accels), abs=1e-6)


def test_nonlinear_path_with_no_law_equals_the_linear_path():
    reference = held((50, 0), (450, 60))
    plain = run_exact(tr.SFLR, [], reference, tr.CONTROLLERS["p2"])
    stepped = tr.Truth(tr.SFLR, [effect("accelerometer_centripetal", "accelerometer", fraction=1e-30)])
    assert stepped.nonlinear
    out = stepped.run(reference, tr.CONTROLLERS["p2"], rounding=False)
    assert out.encoder == pytest.approx(plain.encoder, abs=1e-8)
    assert out.accel == pytest.approx(plain.accel, abs=1e-6)


def test_closed_loop_uses_the_last_samples_reading_and_rounds_half_up():
    out = tr.Truth(axis()).run(held((3, 0), (200, 50)), tr.CONTROLLERS["p2"])
    assert out.command[0] == 0
    expected = np.clip(2 * (out.reference[1:] - out.encoder[:-1]), -200, 200)
    assert np.array_equal(out.command[1:], expected)
    same_row = tr.Truth(axis()).run(held((3, 0), (200, 50)), tr.CONTROLLERS["p2"], command_row=0)
    assert np.array_equal(same_row.command, np.clip(2 * (same_row.reference - same_row.encoder), -200, 200))
    for start, reading in ((-0.5, 0), (0.5, 1), (-0.51, -1), (0.49, 0)):
        out = tr.Truth(axis()).run(np.zeros(3), OPEN, start_angle=start * COUNT)
        assert out.encoder[0] == reading


def test_parts_left_out_make_their_sides_one():
    no_drive = {k: v for k, v in tr.SFLR.items() if k not in ("drive", "clamp")}
    m = mechanics(no_drive)
    beam, tip = tr.SFLR["beam"], tr.SFLR["tip"]
    swing = beam["mass_per_length"] * beam["length"] ** 3 / 3 + tip["mass"] * beam["length"] ** 2
    whole = tr.SFLR["motor"]["inertia"] + tr.SFLR["base"]["inertia"] + swing + tip["inertia"]
    assert m.mass[0, 0] == pytest.approx(whole, rel=1e-9)
    assert np.array_equal(m.port[0], m.port[1]) and np.array_equal(m.port[0], m.port[2])
    assert np.array_equal(m.encoder, m.port[0])
    assert mechanics(tr.RIGID_AXIS).mass == pytest.approx(np.array([[0.02]]))
    assert run_exact(tr.RIGID_AXIS, [], np.ones(10)).accel is None


def test_rigid_axis_spins_up_by_the_closed_form():
    rig = axis()
    j, c, g = 0.02, 0.15, 0.01
    t = np.arange(300) * 0.002
    out = run_exact(rig, [], np.full(300, 50.0))
    tau = j / c
    assert angle(out) == pytest.approx(g * 50 / c * (t - tau * (1 - np.exp(-t / tau))), abs=1e-12)


# --- compensators -------------------------------------------------------------------------------------------


def test_lead_by_tustin_has_the_measured_coefficients():
    _, num, den, *_ = compensator(tr.CONTROLLERS["lead"], 500.0)
    assert num == pytest.approx([18.32547182, -17.20911971], abs=1e-8)
    assert den == pytest.approx([1.0, -0.77672958], abs=1e-8)


def test_kernel_repeats_the_lead_recursion_with_the_limit_inside():
    out = run_exact(tr.SFLR, [], held((10, 0), (300, 100)), tr.CONTROLLERS["lead"])
    e = out.reference - np.r_[0.0, out.encoder[:-1]]
    v = np.zeros(len(e))
    for i in range(1, len(e)):
        v[i] = np.clip(18.32547182 * e[i] - 17.20911971 * e[i - 1] + 0.77672958 * v[i - 1], -200, 200)
    assert out.command == pytest.approx(v, abs=1e-4)
    assert np.max(v) == 200.0


def test_accelerometer_loop_shifts_the_reference_by_its_filtered_reading():
    out = tr.Truth(tr.SFLR).run(held((100, 0), (400, 150)), tr.CONTROLLERS["lead_accel"], accel_offset=1.3)
    a = tr.CONTROLLERS["lead_accel"]
    n, d = a["accel_numerator"], a["accel_denominator"]
    assert out.accel_zero == 1.0
    reading = np.r_[0.0, out.accel[:-1] - 1.0]
    corrected = np.zeros(len(reading))
    for i in range(1, len(reading)):
        corrected[i] = sum(n[k] * reading[i - k] for k in range(4) if i - k >= 1)
        corrected[i] -= sum(d[k] * corrected[i - k] for k in range(1, 4) if i - k >= 1)
    e = out.reference - corrected - np.r_[0.0, out.encoder[:-1]]
    v = np.zeros(len(e))
    for i in range(1, len(e)):
        v[i] = np.clip(18.32547182 * e[i] - 17.20911971 * e[i - 1] + 0.77672958 * v[i - 1], -200, 200)
    assert np.max(np.abs(corrected)) > 1.0
    assert np.max(np.abs(out.command - v)) <= 0.5 + 1e-3


# --- dry friction -------------------------------------------------------------------------------------------


def test_coulomb_friction_stops_a_rigid_axis_at_torque_over_inertia():
    j, torque, g, u = 0.02, 0.05, 0.01, 30.0
    rig = axis(damping=0.0)
    out = run_exact(rig, [effect("coulomb_friction", "motor", torque=torque)], held((100, u), (300, 0)))
    t = np.arange(400) * 0.002
    rise = (g * u - torque) / j
    w = np.where(t <= 0.2, rise * t, np.maximum(rise * 0.2 - torque / j * (t - 0.2), 0.0))
    assert speed(out)[:400] == pytest.approx(w, abs=1e-9)
    w0 = rise * 0.2
    travel = w0 * 0.2 / 2 + w0**2 / (2 * torque / j)
    stops = 0.2 + w0 / (torque / j)
    assert stops < 0.7 or travel > 0
    long = run_exact(rig, [effect("coulomb_friction", "motor", torque=torque)], held((100, u), (700, 0)))
    assert angle(long)[-1] == pytest.approx(travel, abs=1e-7)
    assert speed(long)[-1] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("at", ["motor", "base"])
def test_coulomb_friction_holds_exactly_below_its_level_and_lets_go_above(at):
    cause = [effect("coulomb_friction", at, torque=0.1)]
    assert np.max(np.abs(run_exact(axis(), cause, np.full(500, 9.999)).encoder)) < 1e-12
    assert run_exact(axis(), cause, np.full(500, 10.1)).encoder[-1] > 0.01
    assert run_exact(axis(), cause, np.full(500, -10.1)).encoder[-1] < -0.01


def test_frictions_of_motor_and_base_add_where_there_is_no_drive():
    cause = [effect("coulomb_friction", at, torque=0.1) for at in ("motor", "base")]
    assert np.max(np.abs(run_exact(axis(), cause, np.full(500, 19.9)).encoder)) < 1e-10
    out = run_exact(axis(), cause, np.full(2000, 40.0))
    assert speed(out)[-1] == pytest.approx((0.4 - 0.2) / 0.15, rel=1e-6)


def test_base_friction_holds_the_base_while_the_motor_winds_the_drive():
    k = SHAFT["drive"]["stiffness"]
    out = run_exact(SHAFT, [effect("coulomb_friction", "base", torque=0.3)], np.full(1500, 20.0))
    # A held part has no speed at the ends of a step; a load that changes within it moves it h^2 / 12 load /
    # J.
    assert np.max(np.abs(angle(out))) == pytest.approx(1e-8 / 12 * 0.2 / 0.004, rel=0.02)
    assert out.trace[-1, 0] == pytest.approx(0.2 / k, rel=1e-6)
    assert out.trace[-1, 11] == pytest.approx(-0.2, rel=1e-9)


def test_stribeck_friction_holds_to_static_and_follows_its_curve():
    law = {"static_torque": 0.2, "coulomb_torque": 0.1, "stribeck_velocity": 0.5}
    cause = [effect("stribeck_friction", "motor", **law)]
    assert np.max(np.abs(run_exact(axis(), cause, np.full(500, 19.99)).encoder)) < 1e-12
    for u in (20.5, -24.0, 40.0):
        w = speed(run_exact(axis(), cause, np.full(3000, u)))[-1]
        level = 0.2 - 0.1 * (1 - math.exp(-((w / 0.5) ** 2)))
        assert 0.01 * abs(u) == pytest.approx(0.15 * abs(w) + level, rel=1e-6)
        assert np.sign(w) == np.sign(u)


def test_load_friction_takes_its_share_of_the_drives_torque():
    """Pushed slowly against a spring on the base: gain u = torque (1 + fraction); let go slowly: torque (1 - f)."""
    rig = with_constants(SHAFT, {"motor.damping": 3.0, "drive.damping": 0.3})
    cause = [effect("load_friction", "drive", fraction=0.3), effect("cable_spring", "base", stiffness=1.0, rest=0.0)]
    out = run_exact(rig, cause, held((20000, 50), (20000, 20)))
    assert angle(out)[19999] == pytest.approx(0.5 / 1.3, rel=1e-4)
    assert angle(out)[-1] == pytest.approx(0.2 / 0.7, rel=1e-3)
    held_still = run_exact(rig, cause, held((20000, 50), (4000, 40)))
    assert angle(held_still)[-1] == pytest.approx(angle(held_still)[19999], rel=1e-4)


def test_load_friction_without_a_drive_takes_its_share_of_motor_torque_less_external_torque():
    """Pushed slowly against a spring gain u (1 - f) = torque (1 + f), let go slowly gain u (1 + f) = torque (1 - f)."""
    rig = axis(damping=3.0, gain=0.01)
    cause = [effect("load_friction", "motor", fraction=0.3), effect("cable_spring", "base", stiffness=1.0, rest=0.0)]
    out = run_exact(rig, cause, held((40000, 50), (40000, 10)))
    assert angle(out)[39999] == pytest.approx(0.5 * 0.7 / 1.3, rel=1e-4)
    assert angle(out)[-1] == pytest.approx(0.1 * 1.3 / 0.7, rel=1e-3)
    held_still = run_exact(rig, cause, held((40000, 50), (4000, 20)))
    assert angle(held_still)[-1] == pytest.approx(angle(held_still)[39999], rel=1e-4)


def test_load_friction_alone_on_an_axis_takes_its_share_of_the_motors_torque():
    """Without external torque J w' = (1 - f)(gain u - damping w) as long as the motor drives."""
    j, c, g, f = 0.02, 0.15, 0.01, 0.4
    t = np.arange(300) * 0.002
    out = run_exact(axis(), [effect("load_friction", "motor", fraction=f)], np.full(300, 50.0))
    tau = j / c / (1 - f)
    assert angle(out) == pytest.approx(g * 50 / c * (t - tau * (1 - np.exp(-t / tau))), abs=1e-6)


@pytest.mark.parametrize(
    "cause",
    [
        effect("coulomb_friction", "motor", torque=0.03),
        effect("coulomb_friction", "base", torque=0.03),
        effect("stribeck_friction", "motor", static_torque=0.05, coulomb_torque=0.02, stribeck_velocity=0.3),
        effect("load_friction", "drive", fraction=0.3),
        effect("quadratic_drag", "base", coefficient=0.01),
        effect("sublinear_drag", "motor", coefficient=0.05, speed=0.5),
        effect("backlash", "drive", gap=0.05),
    ],
    ids=lambda e: f"{e['effect']}-{e['at']}",
)
def test_a_rig_left_alone_only_loses_energy(cause):
    rig = with_constants(SHAFT, {"motor.damping": 0.001, "drive.damping": 0.0005})
    out = run_exact(rig, [cause], held((40, 60), (20, -30), (900, 0)))
    th_m, w_m, th_b, w_b = out.trace[:, :4].T
    twist = th_m - th_b
    twist = twist - np.clip(twist, -0.5 * cause.get("gap", 0.0), 0.5 * cause.get("gap", 0.0))
    energy = 0.001 * w_m**2 + 0.002 * w_b**2 + 1.0 * twist**2
    free = energy[60:]
    assert np.all(np.diff(free) <= 1e-7 * free[0])
    assert free[-1] < free[0]


def test_step_size_hardly_matters_and_errors_fall_with_it():
    cause = [
        effect("coulomb_friction", "motor", torque=0.05),
        effect("coulomb_friction", "base", torque=0.01),
        effect("backlash", "drive", gap=0.02),
    ]
    reference = held((50, 0), (500, 80))
    runs = {h: run_exact(tr.SFLR, cause, reference, tr.CONTROLLERS["p2"], h) for h in (1e-5, 1e-4, 4e-4)}
    error = {h: np.max(np.abs(runs[h].encoder - runs[1e-5].encoder)) for h in runs}
    assert error[1e-4] < 0.01
    assert error[1e-4] < 0.5 * error[4e-4]


# --- smooth laws, against another integrator on textbook equations
# -----------------------------------------------


def two_mass_oracle(command: np.ndarray, laws: dict) -> tuple[np.ndarray, np.ndarray]:
    """Motor and base of SHAFT written out by hand, tick by tick, by an adaptive Runge-Kutta method."""
    jm, cm, g, k, c, jb = 0.002, 0.1, 0.01, 2.0, 0.005, 0.004
    gap, cubic = laws.get("gap", 0.0), laws.get("cubic", 0.0)

    def rates(_t: float, x: np.ndarray, u: float) -> list[float]:
        th_m, w_m, th_b, w_b = x
        d, rate = th_m - th_b, w_m - w_b
        over = d - math.copysign(gap / 2, d) if abs(d) > gap / 2 else 0.0
        drive = k * over + cubic * over**3 + (c * rate if abs(d) > gap / 2 or gap == 0.0 else 0.0)
        motor = g * u - cm * w_m - drive + laws.get("motor", lambda th, w: 0.0)(th_m, w_m)
        return [w_m, motor / jm, w_b, (drive + laws.get("base", lambda th, w: 0.0)(th_b, w_b)) / jb]

    x = np.array([laws.get("start", 0.0) + laws.get("place", 0.0) * gap / 2, 0.0, laws.get("start", 0.0), 0.0])
    rows = []
    for u in command:
        rows.append(x)
        step = 2e-4 if gap else np.inf
        x = solve_ivp(rates, (0, 0.002), x, args=(u,), rtol=1e-9, atol=1e-11, max_step=step).y[:, -1]
    return np.array(rows)[:, 0], np.array(rows)[:, 2]


def _sin(a, n, p):
    return lambda th, w: a * math.sin(n * th + p)


@pytest.mark.parametrize(
    ("cause", "laws"),
    [
        (
            effect("sublinear_drag", "motor", coefficient=0.3, speed=0.4),
            {"motor": lambda th, w: -0.3 * w / (1 + abs(w) / 0.4)},
        ),
        (effect("quadratic_drag", "base", coefficient=0.05), {"base": lambda th, w: -0.05 * w * abs(w)}),
        (effect("torque_ripple", "motor", amplitude=0.3, cycles=7.0, phase=0.6), {"motor": _sin(0.3, 7.0, 0.6)}),
        (effect("gravity_tilt", "base", torque=0.4, angle=0.7), {"base": _sin(-0.4, 1.0, -0.7)}),
        (
            effect("cable_spring", "base", stiffness=0.8, rest=-0.3),
            {"base": lambda th, w: -0.8 * (th + 0.3), "start": 0.2},
        ),
        (effect("hardening_spring", "drive", cubic=60.0), {"cubic": 60.0}),
        (effect("backlash", "drive", gap=0.06), {"gap": 0.06, "place": -0.4}),
    ],
    ids=lambda v: v.get("effect", ""),
)
def test_law_agrees_with_another_integrator_on_the_written_out_equations(cause, laws):
    command = held((10, 0), (60, 80), (60, -90), (70, 20))
    keys = {"start_angle": laws.get("start", 0.0), "gap_place": laws.get("place", 0.0)}
    out = run_exact(SHAFT, [cause], command, **keys)
    motor, base = two_mass_oracle(command, laws)
    without = run_exact(SHAFT, [], command, **keys)
    effect_size = np.max(np.abs(angle(without) - base))
    assert effect_size > 0.01
    tolerance = 2e-4 if "gap" in laws else 2e-5
    assert angle(out) == pytest.approx(base, abs=tolerance * effect_size)
    assert out.trace[:, 0] == pytest.approx(motor, abs=tolerance * max(effect_size, 0.1))


def test_gap_and_cubic_together_cube_what_exceeds_the_gap():
    cause = [effect("backlash", "drive", gap=0.04), effect("hardening_spring", "drive", cubic=80.0)]
    command = held((10, 0), (60, 80), (60, -90))
    _, base = two_mass_oracle(command, {"gap": 0.04, "cubic": 80.0})
    assert angle(run_exact(SHAFT, cause, command)) == pytest.approx(base, abs=1e-5)


def test_hardening_clamp_agrees_with_another_integrator_on_the_same_matrices():
    m = mechanics(tr.SFLR, modes=2)
    inv, gain, k3 = np.linalg.inv(m.mass), tr.SFLR["motor"]["gain"], 3000.0
    nq = len(m.mass)

    def rates(_t, z, u):
        q, v = z[:nq], z[nq:]
        d = (m.port[1] - m.port[2]) @ q
        force = gain * u * m.port[0] - k3 * d**3 * (m.port[1] - m.port[2])
        return np.r_[v, inv @ (force - m.stiffness @ q - m.damping @ v)]

    command = held((10, 0), (50, 150), (60, -60))
    z, base = np.zeros(2 * nq), []
    for u in command:
        base.append(m.port[1] @ z[:nq])
        z = solve_ivp(rates, (0, 0.002), z, args=(u,), rtol=1e-8, atol=1e-11).y[:, -1]
    cause = effect("hardening_spring", "clamp", cubic=k3)
    out = tr.Truth(tr.SFLR, [cause], modes=2).run(command, OPEN, rounding=False)
    plain = tr.Truth(tr.SFLR, [], modes=2).run(command, OPEN, rounding=False)
    assert np.max(np.abs(angle(out) - angle(plain))) > 1e-3
    assert angle(out) == pytest.approx(np.array(base), abs=1e-6)


def test_base_stays_put_until_the_motor_has_crossed_its_half_of_the_gap():
    out = run_exact(SHAFT, [effect("backlash", "drive", gap=0.1)], np.full(100, 30.0), gap_place=0.5)
    twist = out.trace[:, 0] - out.trace[:, 2]
    assert out.trace[0, 0] == pytest.approx(0.025)
    inside = np.flatnonzero(np.abs(twist) <= 0.05)
    first = np.flatnonzero(angle(out) > 0)[0]
    assert inside[-1] >= first - 1 or np.all(angle(out)[: inside[-1] + 1] == 0.0)
    assert np.all(angle(out)[:first] == 0.0) and twist[first - 1] <= 0.05 < out.trace[first, 0]


def test_cable_and_tilt_stand_at_their_static_angles():
    rig = axis(damping=0.4)
    cable = [effect("cable_spring", "base", stiffness=0.5, rest=0.2)]
    assert angle(run_exact(rig, cable, np.full(8000, 10.0)))[-1] == pytest.approx(0.2 + 0.1 / 0.5, abs=1e-6)
    tilt = [effect("gravity_tilt", "base", torque=0.5, angle=-0.4)]
    assert angle(run_exact(rig, tilt, np.zeros(8000)))[-1] == pytest.approx(-0.4, abs=1e-6)


# --- amplifier ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("causes", "u", "acts"),
    [
        ([effect("dead_zone", "amplifier", width=6.0)], 50.0, 44.0),
        ([effect("dead_zone", "amplifier", width=6.0)], -50.0, -44.0),
        ([effect("dead_zone", "amplifier", width=6.0)], 5.9, 0.0),
        ([effect("actuator_saturation", "amplifier", limit=40.0)], -90.0, -40.0),
        ([effect("gain_curve", "amplifier", exponent=0.5)], 50.0, 25.0),
        ([effect("gain_curve", "amplifier", exponent=-0.5)], -50.0, -100.0),
        ([effect("gain_asymmetry", "amplifier", ratio=0.8)], -50.0, -40.0),
        ([effect("gain_asymmetry", "amplifier", ratio=0.8)], 50.0, 50.0),
        ([effect("command_bias", "amplifier", offset=-4.0)], 50.0, 46.0),
        ([effect("command_bias", "amplifier", offset=7.0)], 250.0, 207.0),
        (
            [
                effect("command_bias", "amplifier", offset=3.0),
                effect("gain_asymmetry", "amplifier", ratio=0.5),
                effect("gain_curve", "amplifier", exponent=1.0),
                effect("actuator_saturation", "amplifier", limit=100.0),
                effect("dead_zone", "amplifier", width=20.0),
            ],
            -200.0,
            -100.0 * (100.0 / 200.0) * 0.5 + 3.0,
        ),
    ],
)
def test_command_chain_gives_the_terminal_speed_of_the_command_that_acts(causes, u, acts):
    out = run_exact(axis(damping=0.4), causes, np.full(1500, u))
    assert speed(out)[-1] == pytest.approx(0.01 * acts / 0.4, abs=1e-9)


@pytest.mark.parametrize("delay", [0.0007, 0.002, 0.0053])
def test_input_delay_shifts_the_motion_exactly(delay):
    u, j, c, g = 50.0, 0.02, 0.15, 0.01
    tau = j / c
    t = np.arange(200) * 0.002 - delay
    moved = np.where(t > 0, g * u / c * (t - tau * (1 - np.exp(-np.maximum(t, 0) / tau))), 0.0)
    out = run_exact(axis(), [effect("input_delay", "amplifier", time=delay)], np.full(200, u))
    assert angle(out) == pytest.approx(moved, abs=1e-12)


def test_bias_acts_from_sample_0_while_the_delay_still_holds_the_command():
    cause = [
        effect("input_delay", "amplifier", time=0.0101),
        effect("command_bias", "amplifier", offset=5.0),
    ]
    out = run_exact(axis(), cause, np.full(10, 100.0))
    only_bias = run_exact(axis(), [], np.full(10, 5.0))
    assert out.encoder[:6] == pytest.approx(only_bias.encoder[:6], abs=1e-12)
    assert out.encoder[9] > 2 * only_bias.encoder[9]


def test_actuator_lag_is_first_order():
    u, j, g, tau = 50.0, 0.02, 0.01, 0.008
    t = np.arange(100) * 0.002
    out = run_exact(axis(damping=0.0), [effect("actuator_lag", "amplifier", time_constant=tau)], np.full(100, u))
    assert speed(out) == pytest.approx(g * u / j * (t - tau * (1 - np.exp(-t / tau))), abs=1e-12)


def test_clock_scale_is_another_true_rate_under_the_same_compensator():
    reference = held((20, 0), (300, 60))
    scaled = run_exact(tr.SFLR, [effect("clock_scale", "clock", ratio=1.03)], reference, tr.CONTROLLERS["p2"])
    slow = run_exact(tr.SFLR | {"sample_rate": 500 / 1.03}, [], reference, tr.CONTROLLERS["p2"])
    assert scaled.encoder == pytest.approx(slow.encoder, abs=1e-9)
    assert np.array_equal(scaled.t, np.arange(320) / 500)


# --- sensors ------------------------------------------------------------------------------------------------


def test_encoder_delay_reads_the_past_and_holds_the_start_before_it():
    u, j, c, g, delay = 50.0, 0.02, 0.15, 0.01, 0.0053
    tau = j / c
    t = np.arange(200) * 0.002 - delay
    moved = 0.3 + np.where(t > 0, g * u / c * (t - tau * (1 - np.exp(-np.maximum(t, 0) / tau))), 0.0)
    cause = [effect("encoder_delay", "encoder", time=delay)]
    out = run_exact(axis(), cause, np.full(200, u), start_angle=0.3)
    assert out.encoder * COUNT == pytest.approx(moved, abs=1e-12)


def fine_acceleration(command: np.ndarray, factor: int) -> np.ndarray:
    """The tip's reading of SFLR at `factor` times the rate, the command held as at the nominal rate."""
    rig = tr.SFLR | {"sample_rate": 500.0 * factor}
    return run_exact(rig, [], np.repeat(command, factor)).accel


def test_accelerometer_delay_reads_the_past():
    command = held((10, 0), (100, 100), (90, -50))
    fine = fine_acceleration(command, 20)
    out = run_exact(tr.SFLR, [effect("accelerometer_delay", "accelerometer", time=0.0033)], command)
    past = np.arange(200) * 20 - 33
    assert out.accel[2:] == pytest.approx(fine[past[2:]], abs=1e-6)
    assert np.all(out.accel[:2] == 0.0)


@pytest.mark.parametrize(
    ("name", "transfer"),
    [("accelerometer_lag", ([1.0], [0.004, 1.0])), ("accelerometer_highpass", ([0.05, 0.0], [0.05, 1.0]))],
)
def test_accelerometer_filters_are_their_transfer_functions(name, transfer):
    command = held((10, 0), (100, 100), (90, -50))
    fine = fine_acceleration(command, 50)
    t = np.arange(len(fine)) / 25000
    filtered = lsim(transfer, fine, t)[1][::50]
    cause = effect(name, "accelerometer", time_constant=transfer[1][0])
    out = run_exact(tr.SFLR, [cause], command)
    assert np.max(np.abs(filtered - fine[::50])) > 3.0
    assert out.accel == pytest.approx(filtered, abs=0.02)


def test_accelerometer_chain_runs_filter_then_delay_then_clip_with_offset_then_half_up():
    command = held((10, 0), (100, 100), (90, -50))
    late = [
        effect("accelerometer_lag", "accelerometer", time_constant=0.002),
        effect("accelerometer_delay", "accelerometer", time=0.004),
    ]
    both = run_exact(tr.SFLR, late, command).accel
    lagged = run_exact(tr.SFLR, late[:1], command).accel
    assert both[2:] == pytest.approx(lagged[:-2], abs=1e-9)
    clip = [effect("accelerometer_saturation", "accelerometer", limit=10.25)]
    plain = run_exact(tr.SFLR, [], command).accel
    out = run_exact(tr.SFLR, clip, command, accel_offset=4.0).accel
    assert out == pytest.approx(np.clip(plain + 4.0, -10.25, 10.25), abs=1e-12)
    assert out.max() == 10.25 and out.min() == -10.25
    rounded = tr.Truth(tr.SFLR, clip).run(command, OPEN, accel_offset=4.0).accel
    assert np.array_equal(rounded, np.floor(out + 0.5))


def test_accelerometer_noise_is_white_with_the_asked_sigma():
    out = tr.Truth(tr.SFLR).run(np.zeros(20000), OPEN, accel_sigma=0.9, rng=np.random.default_rng(3))
    assert out.accel.std() == pytest.approx(math.sqrt(0.9**2 + 1 / 12), rel=0.03)
    assert abs(np.corrcoef(out.accel[1:], out.accel[:-1])[0, 1]) < 0.03
    assert np.array_equal(out.accel, np.round(out.accel))


def test_centripetal_adds_its_share_of_length_times_speed_squared():
    command = np.full(3000, 60.0)
    cause = [effect("accelerometer_centripetal", "accelerometer", fraction=0.2)]
    out, plain = run_exact(tr.SFLR, cause, command), run_exact(tr.SFLR, [], command)
    added = tr.SFLR["accelerometer"]["gain"] * 0.2 * tr.SFLR["beam"]["length"] * speed(plain) ** 2
    assert np.max(added) > 1.0
    assert out.accel - plain.accel == pytest.approx(added, abs=1e-5)


def test_encoder_eccentricity_and_zero():
    command = np.full(1000, 60.0)
    cause = [effect("encoder_eccentricity", "encoder", amplitude=3.0, phase=0.8)]
    out = tr.Truth(axis(), cause).run(command, OPEN, zero_angle=0.25)
    th = angle(out)
    expected = th / COUNT + 3.0 * np.sin(th + 0.8) - 0.25 / COUNT
    assert np.array_equal(out.encoder, np.floor(expected + 0.5))
    assert np.ptp(th) > 6.0


# --- start --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "causes",
    [
        [effect("coulomb_friction", "motor", torque=0.1), effect("cable_spring", "base", stiffness=0.2, rest=0.3)],
        [effect("coulomb_friction", "motor", torque=0.1), effect("command_bias", "amplifier", offset=4.0)],
        [effect("cable_spring", "base", stiffness=0.2, rest=0.3), effect("command_bias", "amplifier", offset=4.0)],
        [effect("coulomb_friction", "base", torque=0.1), effect("command_bias", "amplifier", offset=4.0)],
        [
            effect("gravity_tilt", "base", torque=0.2, angle=0.3),
            effect("command_bias", "amplifier", offset=4.0),
            effect("backlash", "drive", gap=0.03),
            effect("hardening_spring", "drive", cubic=5.0),
            effect("actuator_lag", "amplifier", time_constant=0.01),
            effect("input_delay", "amplifier", time=0.003),
        ],
    ],
)
def test_equilibrium_starts_at_rest_and_stays(causes):
    out = run_exact(tr.SFLR, causes, np.zeros(300), start="equilibrium", start_angle=0.05)
    assert np.ptp(out.encoder) < 1e-6
    assert np.max(np.abs(out.accel)) < 1e-4
    released = run_exact(tr.SFLR, causes, np.zeros(300), start_angle=0.05)
    assert np.ptp(released.encoder) > 0.01 or causes[0]["effect"] == "coulomb_friction"


def test_equilibrium_is_refused_where_nothing_holds_the_rig():
    truth = tr.Truth(tr.SFLR, [effect("command_bias", "amplifier", offset=4.0)])
    with pytest.raises(ValueError, match="no equilibrium"):
        truth.run(np.zeros(10), OPEN, start="equilibrium")


# --- effects as a set ---------------------------------------------------------------------------------------


def test_every_effect_of_the_catalogue_moves_the_outputs_and_vanishes_with_its_size():
    rng = np.random.default_rng(5)
    reference = held((100, 0), (600, 180), (500, -20))
    plain = run_exact(tr.SFLR, [], reference, tr.CONTROLLERS["p2"], gap_place=0.3)
    scale = np.array([1.0, 1.0])
    assert set(tr.CATALOGUE) - set(tr.effect_names(tr.SFLR)) == {("load_friction", "motor")}
    assert len(tr.effect_names(tr.SFLR)) == 27
    for name, at in tr.effect_names(tr.SFLR):
        shape = tr.draw_effect(name, rng, tr.SFLR, at)
        sizes = []
        for factor in (1.0, 1e-6):
            cause = tr.scaled(shape, factor, tr.SFLR)
            out = run_exact(tr.SFLR, [cause], reference, tr.CONTROLLERS["p2"], gap_place=0.3)
            gap = np.array([np.ptp(out.encoder - plain.encoder), np.ptp(out.accel - plain.accel)]) / scale
            sizes.append(np.max(gap))
        assert sizes[0] > 0.2, (name, at)
        assert sizes[1] < 2e-3, (name, at)


def test_parameter_cause_is_that_constant():
    reference = held((50, 0), (300, 80))
    cause = [{"effect": "parameter:tip.mass", "at": "", "value": 0.02}]
    moved = run_exact(tr.SFLR, cause, reference, tr.CONTROLLERS["p2"])
    same = run_exact(with_constants(tr.SFLR, {"tip.mass": 0.02}), [], reference, tr.CONTROLLERS["p2"])
    assert np.array_equal(moved.encoder, same.encoder)


@pytest.mark.parametrize(
    "wrong",
    [
        [effect("coulomb_friction", "beam", torque=1.0)],
        [effect("dead_zone", "amplifier", wide=1.0)],
        [effect("dead_zone", "amplifier", width=1.0)] * 2,
        [{"effect": "parameter:motor.colour", "at": "", "value": 1.0}],
    ],
)
def test_effects_that_do_not_exist_are_refused(wrong):
    with pytest.raises(ValueError):
        tr.Truth(tr.SFLR, wrong)


def test_effects_need_their_part():
    with pytest.raises(ValueError, match="no drive"):
        tr.Truth(tr.RIGID_AXIS, [effect("load_friction", "drive", fraction=0.2)])
    with pytest.raises(ValueError, match="has a drive"):
        tr.Truth(tr.TWO_MASS, [effect("load_friction", "motor", fraction=0.2)])


# --- a geared servo -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_servo_case_hides_friction_by_load_and_need_not_say_what_closed_its_loops():
    told, silent = (tr.make_case(21, ["load_friction"], nominal=tr.SERVO, count=4, known_controller=known)
                    for known in (True, False))
    assert [c["effect"] for c in silent.truth["causes"]] == ["load_friction"] and silent.truth == told.truth
    assert {r.metadata.controller["kind"] for r in told.runs} == {"p"}
    assert {r.metadata.controller["kind"] for r in silent.runs} == {"unknown"}
    for one, other in zip(told.runs, silent.runs, strict=True):
        assert one.accel is None and np.array_equal(one.encoder, other.encoder) and np.ptp(one.encoder) > 100
        assert np.max(np.abs(one.command)) <= 885 and not other.open_loop


def test_a_servos_gravity_belongs_to_the_rig_and_pulls_it_down():
    swings = tr.Truth(tr.SERVO).run(np.zeros(2000), OPEN, start_angle=0.4, rounding=False)
    assert angle(swings)[0] == 0.4 and abs(angle(swings)[-1]) < 1e-3 and np.min(angle(swings)) < -0.05
    assert ("gravity_tilt", "base") not in tr.effect_names(tr.SERVO)
    with pytest.raises(ValueError, match="more than once"):
        tr.Truth(tr.SERVO, [effect("gravity_tilt", "base", torque=0.1, angle=0.0)])


# --- imperfect worlds ---------------------------------------------------------------------------------------


def gap(one, other, name: str) -> float:
    return float(np.sqrt(np.mean((getattr(one, name) - getattr(other, name)) ** 2)))


def still(n: int) -> Pushes:
    return Pushes(*np.zeros((4, n)), 0.0, 0.0)


def test_coloured_disturbances_have_their_variance_and_correlation_time():
    rng, period, time = np.random.default_rng(3), 0.002, 0.05
    paths = np.array([gauss_markov(rng, 500, period, time) for _ in range(4000)])
    assert np.mean(paths**2, axis=0) == pytest.approx(np.ones(500), abs=0.12)
    for lag in (1, 10, 25, 100):
        found = np.mean(paths[:, lag:] * paths[:, :-lag])
        assert found == pytest.approx(math.exp(-lag * period / time), abs=0.02)


@pytest.mark.parametrize("level", [0.01, 0.02])
def test_the_torque_that_is_missing_has_the_stated_share_of_the_commands(level):
    """On an axis J w' + c w - gain u is the disturbance: what acts, found from the motion, over many worlds."""
    truth, reference = tr.Truth(axis()), multisine_test(500.0, 100.0, 4).reference
    j, c, g = 0.02, 0.15, 0.01
    keep = math.exp(-c / j * 0.002)
    shares = []
    for seed in range(150):
        quiet = truth.run(reference, tr.CONTROLLERS["p1"], rounding=False)
        pushes = draw_pushes(draw_world(seed, level), truth, quiet, seed)
        out = truth.run(reference, tr.CONTROLLERS["p1"], rounding=False, pushes=pushes)
        w = speed(out)
        missing = (w[1:] - keep * w[:-1]) * c / (1.0 - keep) - g * out.command[:-1]
        shares.append(np.mean(missing**2) / np.mean((g * quiet.command) ** 2))
    assert math.sqrt(np.mean(shares)) == pytest.approx(level, rel=0.06)


def test_the_accelerometers_error_has_the_stated_share_of_its_signal():
    """Force on the tip and noise of the sensor each half of its power, exactly on a linear rig in open loop."""
    level, reference = 0.02, prbs_test(500.0, 120.0, 5).reference
    truth = tr.Truth(tr.SFLR)
    quiet = truth.run(reference, OPEN, rounding=False)
    signal, noises = np.std(quiet.accel), []
    for seed in range(40):
        drawn = draw_pushes(draw_world(seed, level), truth, quiet, seed)
        only = replace(still(len(reference)), force=drawn.force)
        out = truth.run(reference, OPEN, rounding=False, pushes=only)
        assert gap(out, quiet, "accel") == pytest.approx(level / math.sqrt(2) * signal, rel=1e-6)
        assert gap(out, quiet, "encoder") > 0.0
        noises.append(np.mean(drawn.noise**2))
    assert math.sqrt(np.mean(noises)) == pytest.approx(level / math.sqrt(2) * signal, rel=0.06)


def test_a_start_that_is_not_quite_at_rest_turns_and_is_bent_by_its_share_of_the_motion():
    truth, reference = tr.Truth(tr.SFLR), held((100, 0), (600, 100))
    quiet = truth.run(reference, tr.CONTROLLERS["lead"], rounding=False)
    drawn = [draw_pushes(draw_world(seed, 0.02), truth, quiet, seed) for seed in range(300)]
    out = truth.run(reference, tr.CONTROLLERS["lead"], rounding=False, pushes=drawn[0])
    length = tr.SFLR["beam"]["length"]
    assert speed(out)[0] == pytest.approx(drawn[0].speed, rel=1e-9)
    assert out.trace[0, 6] - length * out.trace[0, 4] == pytest.approx(drawn[0].bend, rel=1e-9)
    bends = np.std(quiet.trace[:, 6] - length * quiet.trace[:, 4])
    assert np.std([p.speed for p in drawn]) == pytest.approx(0.02 * np.std(speed(quiet)), rel=0.15)
    assert np.std([p.bend for p in drawn]) == pytest.approx(0.02 * bends, rel=0.15)


def test_modes_are_moved_by_their_own_factors_and_the_rigid_arm_not_at_all():
    world = draw_world(7, 0.02)
    assert 0.002 < np.std(np.log(world.detuning)) < 0.02 and len(set(world.detuning)) == 8
    plain, moved = (mechanics(tr.SFLR, detuning=d) for d in ((), world.detuning))
    assert np.array_equal(plain.mass, moved.mass)
    held_root = [np.sqrt(eigh(m.stiffness[3:, 3:], m.mass[3:, 3:], eigvals_only=True)) for m in (plain, moved)]
    order = np.argsort(held_root[0] * np.array(world.detuning))
    assert held_root[1] == pytest.approx((held_root[0] * np.array(world.detuning))[order], rel=1e-9)
    assert np.max(np.abs(moved.stiffness @ moved.lift[0])) < 1e-10


def looped(loop: str, level: float, seed: int) -> tuple[tr.Truth, World, tr.Output, Callable[..., tr.Output]]:
    """A rig, a world, a run of one second without disturbances, and what makes such runs."""
    test = tr.step_test(500.0, loop, 8.0, 1.0) if loop != "open" else tr.pulse_test(500.0, 60.0, duration=1.0)
    truth = tr.Truth(tr.SFLR)

    def run(truth, pushes, reference=None):
        reference = test.reference if reference is None else reference
        return truth.run(reference, tr.CONTROLLERS[loop], rounding=False, pushes=pushes)

    return truth, draw_world(seed, level), run(truth, None), run


def both(out: tr.Output) -> np.ndarray:
    return np.concatenate([out.encoder, out.accel])


@pytest.mark.parametrize("loop", [*(pytest.param(loop, marks=pytest.mark.long) for loop in ("open", "p2", "lead")),
                                  "lead_accel"])
def test_disturbances_scatter_as_their_covariance_says_quick_and_slow(loop):
    """Drawn ones, sent through the whole simulation, have along the covariance's axes the variance that it says: where
    that is far above a sensor's noise, beside it and below it."""
    level, noise = 1e-4, 1e-3  # counts; at a level at which modes and starts act in proportion
    parts = {"far above": [], "above": [], "about": []}
    for seed in range(8):
        truth, world, quiet, run = looped(loop, level, seed)
        (_, covariance), = covariances(world, truth, quiet, run)
        moved = both(run(truth.detuned(world.detuning), draw_pushes(world, truth, quiet, seed))) - both(quiet)
        variances, axes = eigh(covariance / noise**2)
        read = axes.T @ (moved / noise + np.random.default_rng(seed).standard_normal(len(moved)))
        white = read**2 / (1.0 + variances)
        for part, (low, high) in zip(parts, ((10.0, 1e9), (1.0, 10.0), (0.1, 1.0)), strict=True):
            parts[part] += white[(variances > low) & (variances <= high)].tolist()
    for part, found in parts.items():
        assert np.mean(found) == pytest.approx(1.0, abs=5.0 * math.sqrt(2.0 / len(found)) + 0.02), part


def test_what_a_path_does_behind_a_response_is_worked_out_tick_by_tick():
    """The short way is H K H' with the responses' whole matrices H, in every piece."""
    n, decay = 90, 0.9
    answers = np.random.default_rng(1).standard_normal((2, n)) * 0.97 ** np.arange(n)
    ages = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    whole = np.vstack([toeplitz(a, np.zeros(n)) for a in answers])
    whole = whole @ decay**ages @ whole.T
    for begin, end in ((0, n), (0, 30), (30, 75)):
        rows = np.concatenate([np.arange(begin, end), np.arange(begin, end) + n])
        assert carried(answers, decay, begin, end) == pytest.approx(whole[np.ix_(rows, rows)], rel=1e-9, abs=1e-12)
    assert shocks(n, decay) @ shocks(n, decay).T == pytest.approx(decay**ages, rel=1e-12)


@pytest.mark.long
def test_the_pieces_of_a_long_run_are_parts_of_its_whole(monkeypatch):
    truth, world, quiet, run = looped("lead", 0.02, 3)
    (rows, whole), = covariances(world, truth, quiet, run)
    monkeypatch.setattr(disturbance, "PIECE", 180)
    pieces = covariances(world, truth, quiet, run)
    assert sorted(np.concatenate([part for part, _ in pieces])) == sorted(rows) and len(pieces) == 3
    for part, piece in pieces:
        assert piece == pytest.approx(whole[np.ix_(part, part)], rel=1e-6, abs=1e-9 * whole.max())


@pytest.mark.long
def test_severity_in_a_world_takes_its_disturbances_for_what_they_are():
    """Chi squared by disturbance counts for no more than its share of the degrees of freedom."""
    case = tr.make_case(301, ["coulomb_friction"], count=3)
    measure = tr.Severity(case.rig, case.truth["logs"], case.truth["common"], case.tests, case.conditions,
                          world=draw_world(301, 0.02))
    quiet, disturbed = (weighted(tr.simulate_case(case.rig, [], case.tests, case.conditions, exact=True, world=world),
                                 case.conditions, read=True) for world in (None, draw_world(301, 0.02)))
    noise = np.random.default_rng(5).standard_normal(len(quiet))
    error = disturbed - quiet + noise
    assert np.mean(error**2) > 5.0 and len(error) == sum(2 * len(test.reference) for test in case.tests)
    assert np.mean(measure._counted(error) ** 2) == pytest.approx(1.0, abs=0.05)
    cause, (grade,) = case.effects[0], case.truth["severity"].values()
    faint = tr.Severity(case.rig, case.truth["logs"], case.truth["common"], case.tests, case.conditions,
                        world=draw_world(301, 1e-7))
    assert faint.of(cause) == pytest.approx(grade, rel=0.02)
    assert 10.0 < measure.of(cause) < 0.3 * grade


def test_a_case_sized_in_its_world_is_as_plain_there_as_its_band_says():
    case = tr.make_case(8, ["command_bias"], count=3, band=(230.0, 2000.0), disturbance=0.02, sized_in_world=True)
    grade, = case.truth["severity_in_world"].values()
    assert 230.0 <= grade <= 2000.0 < next(iter(case.truth["severity"].values()))


def disturbed_axis(seed: int, n: int, sigma: float, time: float) -> tuple[tr.Output, np.ndarray]:
    """An open loop on the axis under a coloured torque, read with rounding, and that torque."""
    rng = np.random.default_rng(seed)
    torque = sigma * gauss_markov(rng, n, 0.002, time)
    command = np.repeat(rng.integers(-80, 81, n), rng.integers(5, 40, n))[:n].astype(float)
    pushes = replace(still(n), torque=torque)
    return tr.Truth(axis()).run(command, OPEN, pushes=pushes), torque


def test_innovations_are_those_of_the_joint_density_of_all_readings():
    """Of few rows the density is written out whole: mean and covariance of all readings from the very start."""
    n, coloured, force = 12, Coloured(0.3, 0.02), Coloured(0.02, 0.005)
    rng = np.random.default_rng(2)
    command, readings = rng.uniform(-50, 50, n), rng.normal(0.0, 3.0, (n, 2))
    found = innovations(tr.SFLR, command, readings, torque=coloured, force=force, start_spread=0.0)
    truth = tr.Truth(tr.SFLR)

    def answer(command=None, **pushes) -> np.ndarray:
        out = truth.run(np.zeros(n) if command is None else command, OPEN, rounding=False,
                        pushes=replace(still(n), **pushes))
        return np.column_stack([out.encoder, out.accel]).ravel()

    covariance = np.diag(np.tile([0.29**2, 1.0], n))
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) * 0.002
    for name, c in (("torque", coloured), ("force", force)):
        moves = np.array([answer(**{name: np.eye(n)[k]}) for k in range(n)]).T
        covariance += moves @ (c.sigma**2 * np.exp(-lag / c.time)) @ moves.T
    e = readings.ravel() - answer(command)
    whole = -0.5 * (e @ np.linalg.solve(covariance, e) + np.linalg.slogdet(2 * math.pi * covariance)[1])
    assert found.log_likelihood == pytest.approx(whole, rel=1e-6)
    assert np.sum(found.whitened**2) == pytest.approx(e @ np.linalg.solve(covariance, e), rel=1e-6)


def test_innovations_are_white_likeliest_at_the_truth_and_the_smoothed_torque_is_what_acted():
    out, torque = disturbed_axis(3, 1500, 0.05, 0.3)
    readings = out.encoder[:, None]
    found = innovations(axis(), out.command, readings, torque=Coloured(0.05, 0.3))
    white = found.whitened[50:, 0]
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(white[1:] * white[:-1])) < 0.1
    others = [innovations(axis(), out.command, readings, torque=c).log_likelihood
              for c in (None, Coloured(0.01, 0.3), Coloured(0.25, 0.3), Coloured(0.05, 0.01))]
    assert all(found.log_likelihood > other + 5.0 for other in others)
    score = (found.smoothed[50:-50, 0] - torque[50:-50]) / found.deviations[50:-50, 0]
    assert np.mean(score**2) == pytest.approx(1.0, abs=0.35)
    assert np.corrcoef(found.smoothed[50:-50, 0], torque[50:-50])[0, 1] > 0.9
    stronger = with_constants(axis(), {"motor.gain": 0.012})
    wrong = innovations(stronger, out.command, readings, torque=Coloured(0.05, 0.3))
    assert found.log_likelihood > wrong.log_likelihood + 20.0


def test_level_0_is_the_perfect_world_bit_by_bit():
    tests = [tr.step_test(500.0, "lead", 100.0, 1.0), tr.pulse_test(500.0, 120.0, duration=1.0)]
    plain, none = (tr.make_case(5, ["coulomb_friction"], tests, band=None, **k) for k in ({}, {"disturbance": 0.0}))
    assert plain.truth == none.truth and draw_world(5, 0.0) is None
    assert all(np.array_equal(a.encoder, b.encoder) and np.array_equal(a.accel, b.accel)
               for a, b in zip(plain.runs, none.runs, strict=True))
    reference, truth = tests[0].reference, tr.Truth(tr.SFLR, plain.effects)
    one, other = (truth.run(reference, tr.CONTROLLERS["lead"], accel_sigma=1.0, pushes=pushes)
                  for pushes in (None, still(len(reference))))
    assert np.array_equal(one.trace, other.trace) and np.array_equal(one.accel, other.accel)


def test_an_imperfect_case_hides_what_its_perfect_twin_hides_and_repeats_by_its_seed():
    tests = [tr.step_test(500.0, "lead", 100.0, 1.0), tr.pulse_test(500.0, 120.0, duration=1.0)]
    twin, case, again, harder = (tr.make_case(6, ["dead_zone"], tests, band=None, disturbance=level)
                                 for level in (0.0, 0.02, 0.02, 0.04))
    seen = {"causes", "constants", "logs", "common", "severity", "conditions", "seed", "outside"}
    assert all(twin.truth[key] == case.truth[key] for key in seen)
    assert set(case.truth) - seen == {"disturbance", "severity_in_world"}
    assert 0.0 < case.truth["severity_in_world"]["dead_zone@amplifier"] < case.truth["severity"]["dead_zone@amplifier"]
    assert case.truth == again.truth and case.truth["disturbance"]["level"] == 0.02
    assert json.loads(json.dumps(case.truth)) is not None
    for one, two, three, four in zip(twin.runs, case.runs, again.runs, harder.runs, strict=True):
        assert np.array_equal(two.encoder, three.encoder) and np.array_equal(two.accel, three.accel)
        assert 0.0 < gap(one, two, "accel") < gap(one, four, "accel")
        assert one.metadata == two.metadata and one.columns().keys() == two.columns().keys(), "blind"


# --- outside the catalogue ----------------------------------------------------------------------------------


def test_bristle_yields_like_a_spring_before_it_slips():
    law = {"torque": 0.2, "stiffness": 2.0, "wave": 0.0, "cycles": 1.0, "phase": 0.0}
    rig = axis(damping=0.4)
    resting = run_exact(rig, [effect("presliding_friction", "", **law)], held((2000, 5), (2000, 0)))
    bent = angle(resting)[1999]
    assert bent == pytest.approx(-(0.2 / 2.0) * math.log(1 - 0.05 / 0.2), rel=1e-3)
    assert abs(angle(resting)[-1]) < 0.3 * bent
    sliding = run_exact(rig, [effect("presliding_friction", "", **law)], np.full(3000, 60.0))
    assert speed(sliding)[-1] == pytest.approx((0.6 - 0.2) / 0.4, rel=1e-4)


def test_mount_and_appendage_add_the_modes_of_their_closed_forms():
    rig = with_constants(tr.RIGID_AXIS, {"motor.damping": 0.0})
    body = {"inertia": 0.01, "stiffness": 20.0, "damping": 0.0}
    for name, inertias in (("second_appendage", (0.02, 0.01)), ("mount_compliance", None)):
        m = mechanics(rig, {name: body})
        w = np.sqrt(np.abs(eigh(m.stiffness, m.mass, eigvals_only=True)))
        expected = math.sqrt(20.0 * sum(1 / j for j in inertias)) if inertias else math.sqrt(20.0 / 0.01)
        assert w[-1] == pytest.approx(expected)
    frame = mechanics(rig, {"mount_compliance": body})
    assert np.array_equal(frame.encoder, [1.0, -1.0]) or np.array_equal(frame.encoder, [-1.0, 1.0])


def test_stops_turn_the_base_back_and_touch_nothing_before():
    law = effect("end_stop", "", angle=0.3, stiffness=50.0, damping=0.02)
    command = held((10, 0), (400, 40))
    out, free = run_exact(tr.SFLR, [law], command), run_exact(tr.SFLR, [], command)
    before = angle(free) < 0.29
    assert angle(out)[before] == pytest.approx(angle(free)[before], abs=1e-7)
    assert angle(free)[-1] > 0.5 > 0.35 > angle(out).max()


def test_lost_counts_and_a_stuck_bit_are_in_the_readings_alone():
    command = held((100, 0), (200, 80), (700, 0))
    slip = tr.Truth(tr.SFLR, [effect("encoder_slip", "", counts=5.0, mean_time=0.5)])
    out, plain = slip.run(command, OPEN), tr.Truth(tr.SFLR).run(command, OPEN)
    lost = out.encoder - plain.encoder
    assert np.all(np.isin(np.diff(lost), [0.0, 5.0])) and lost[-1] >= 5.0
    assert angle(out) == pytest.approx(angle(plain), abs=1e-12)
    out = tr.Truth(tr.SFLR, [effect("stuck_bit", "", bit=3.0, value=1.0)]).run(command, OPEN)
    assert np.all((out.accel.astype(int) + 32768) & 8)
    assert np.all(np.isin(out.accel - plain.accel, [0.0, 8.0]))


def test_motor_fades_with_heat_and_friction_warms_up():
    rig = axis(damping=0.4)
    faded = run_exact(rig, [effect("motor_fade", "", loss=1.0, time=0.5)], np.full(5000, 100.0))
    assert speed(faded)[-1] == pytest.approx(0.01 * 100 / (1 + 0.25) / 0.4, rel=1e-3)
    cause = effect("friction_drift", "", torque=0.1, change=2.0, time=0.5)
    dragged = run_exact(rig, [cause], np.full(5000, 100.0))
    assert speed(dragged)[-1] == pytest.approx((1.0 - 0.3) / 0.4, rel=1e-3)


def test_loose_mass_keeps_its_momentum_until_it_is_hit():
    law = effect("tip_rattle", "", mass=0.01, gap=0.01, stiffness=4000.0, damping=1.0)
    out = run_exact(tr.SFLR, [law], held((10, 0), (200, 100)))
    tip, loose = out.trace[:, 6], out.trace[:, 8]
    apart = np.abs(tip - loose) < 0.005
    first = np.flatnonzero(~apart)[0]
    assert np.all(loose[:first] == 0.0) and tip[first] > 0.005
    assert np.max(np.abs(tip - loose)) < 0.02


# --- cases --------------------------------------------------------------------------------------------------


def test_constants_stay_within_two_sigma_and_the_motor_has_a_common_factor():
    rng = np.random.default_rng(0)
    ratios = {k: [] for k in tr.uncertain_keys(tr.SFLR)}
    for _ in range(400):
        rig = tr.draw_constants(tr.SFLR, None, rng)
        for key in ratios:
            table, name = key.split(".")
            ratios[key].append(math.log(rig[table][name] / tr.SFLR[table][name]))
    assert "beam.length" in ratios and "encoder.counts_per_revolution" not in ratios
    for key, logs in ratios.items():
        common = 1.0 if key.startswith("motor.") else 0.0
        sigma = own_sigma(tr.SFLR["uncertainty"], key)
        assert np.max(np.abs(logs)) <= 2 * (sigma + common)
        spread = math.hypot(sigma, common) * 0.88  # a Gaussian cut at two sigma
        assert np.std(logs) == pytest.approx(spread, rel=0.12)
    gain, damping = np.array(ratios["motor.gain"]), np.array(ratios["motor.damping"])
    assert np.std(gain - damping) == pytest.approx(0.1 * math.sqrt(2) * 0.88, rel=0.12)


def test_case_is_repeatable_and_blind():
    case, again = tr.make_case(11, ["coulomb_friction"]), tr.make_case(11, ["coulomb_friction"])
    assert case.truth == again.truth
    assert all(
        np.array_equal(a.encoder, b.encoder) and np.array_equal(a.accel, b.accel)
        for a, b in zip(case.runs, again.runs, strict=True)
    )
    assert 5 <= len(case.runs) <= 8
    for run in case.runs:
        shown = str(run.metadata.model_dump()) + run.name
        assert "coulomb" not in shown and "torque" not in shown and run.metadata.rig == "sflr"
        assert np.array_equal(run.encoder, np.round(run.encoder))
        assert run.metadata.command_row == -1 and np.all(run.reference[:100] == 0)
        assert np.max(np.abs(run.command)) <= 200
    assert 200 < case.truth["severity"][f"coulomb_friction@{case.truth['causes'][0]['at']}"] < 100001
    other = tr.make_case(12, ["coulomb_friction"])
    assert other.truth["constants"] != case.truth["constants"]


def test_subtle_cases_are_subtle_and_clean_ones_are_clean():
    case = tr.make_case(21, ["dead_zone"], band="subtle")
    assert 25 < case.truth["severity"]["dead_zone@amplifier"] < 200
    assert tr.make_case(21, []).truth["causes"] == []


def test_severity_of_what_the_constants_can_imitate_is_their_penalty():
    """A gain four sigma off on an axis whose every constant is free costs the data nothing but that
    penalty."""
    rig = axis()
    tests = [tr.step_test(500.0, "p2", 100.0), tr.pulse_test(500.0, 100.0)]
    conditions = [tr.Conditions(), tr.Conditions()]
    zero = dict.fromkeys(tr.uncertain_keys(rig), 0.0)
    cause = {"effect": "parameter:motor.gain", "at": "", "value": 0.01 * math.exp(0.4)}
    # The data fix the gain's ratios to inertia and damping, so all three share 0.4: least squares of
    # a^2 + 2 b^2 (in sigmas of 0.1) with a - b = 4: a = 8/3, b = -4/3.
    value = tr.Severity(rig, zero, zero, tests, conditions).of(cause)
    assert value == pytest.approx((8 / 3) ** 2 + 2 * (4 / 3) ** 2, abs=4.0)
    assert tr.Severity(rig, zero, zero, tests, conditions).of(effect("dead_zone", "amplifier", width=1e-4)) < 1.0


def test_a_wrong_clock_is_rescaled_constants_to_the_last_digit():
    ratio = 1.04
    move = {k: tr.SFLR[k.split(".")[0]][k.split(".")[1]] for k in tr.uncertain_keys(tr.SFLR)}
    for key, value in move.items():
        last = key.split(".")[1]
        if last in ("inertia", "mass", "mass_per_length") or key == "accelerometer.gain":
            move[key] = value / ratio**2
        elif last == "damping":
            move[key] = value / ratio
    reference = held((50, 0), (400, 80))
    clock = run_exact(tr.SFLR, [effect("clock_scale", "clock", ratio=ratio)], reference, tr.CONTROLLERS["lead_accel"])
    same = run_exact(with_constants(tr.SFLR, move), [], reference, tr.CONTROLLERS["lead_accel"])
    assert clock.encoder == pytest.approx(same.encoder, abs=1e-7)
    assert clock.accel == pytest.approx(same.accel, abs=1e-6)
    case = tr.make_case(4, ["clock_scale"])
    assert abs(case.truth["severity"]["clock_scale@clock"]) < 60
    run = case.runs[0]
    slope = np.polyfit(run.device_time, run.host_time, 1)[0]
    assert slope == pytest.approx(case.effects[0]["ratio"], abs=1e-4)


def test_other_rigs_make_cases_too():
    for rig, name in ((tr.RIGID_AXIS, "coulomb_friction"), (tr.TWO_MASS, "backlash")):
        case = tr.make_case(3, [name], nominal=rig)
        assert all(r.accel is None for r in case.runs)


def test_command_line_writes_the_contracts_csv(tmp_path):
    root = Path(__file__).parents[1]
    command = [sys.executable, "-m", "tests.truth", "3", "dead_zone", "--out", str(tmp_path)]
    subprocess.run(command, cwd=root, check=True, timeout=120)
    files = sorted(tmp_path.glob("*.csv"))
    assert len(files) >= 5 and (tmp_path / "truth.json").exists()
    lines = files[0].read_text(encoding="utf-8").splitlines()
    assert "t,reference,command,encoder,accel" in lines
    assert "dead_zone" not in "".join(lines)
