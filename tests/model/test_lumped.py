"""The discrete-time transfer matrix method: its error in time and its chain's error in space, apart."""

import control
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings

from station.control.compensators import Compensator
from station.model.linear import natural_frequencies, state_space
from station.model.lumped import DiscreteChain, lumped_assembly, run_chain
from station.model.simulate import simulate
from station.rig import Limits, Rig, load_rig
from station.runs.run import Run, RunMetadata
from tests.measured import measured_log
from tests.model.random_rigs import rigs

PULSES = np.concatenate([np.zeros(5), np.full(30, 100.0), np.zeros(40), np.full(25, -60.0), np.zeros(50)])
CONTROLLERS = {
    "open": {"kind": "open"},
    "p": {"kind": "p", "gain": 2.0},
    "lead": {"kind": "lead", "gain": 20.0, "zero": 31.4159, "pole": 125.6637},
    "lead_accel": {"kind": "lead_accel", "gain": 20.0, "zero": 31.4159, "pole": 125.6637,
                   "accel_numerator": [0.00045097, 0.00045152, -0.00044989, -0.00045043],
                   "accel_denominator": [1.0, -2.9289362, 2.85853684, -0.92960052]}}


def frequencies(rig: Rig, lumps: int) -> np.ndarray:
    parts = lumped_assembly(rig, lumps)
    squared = scipy.linalg.eigh(parts.stiffness, parts.mass, eigvals_only=True)
    return np.sqrt(np.maximum(squared, 0.0)) / (2.0 * np.pi)


def newmark(rig: Rig, lumps: int, dt: float, commands: np.ndarray, steps: int) -> np.ndarray:
    """The same rule on the assembled matrices: encoder and accelerometer before each command."""
    parts = lumped_assembly(rig, lumps)
    force = rig.motor.gain * parts.unit(parts.motor)
    system = parts.mass * 4.0 / dt**2 + parts.damping * 2.0 / dt + parts.stiffness
    x, v, acc, old, rows = *np.zeros((3, parts.size)), 0.0, []
    for command in commands:
        tip = acc[parts.tip] * rig.accelerometer.gain if parts.tip is not None else 0.0
        rows.append((x[parts.base] / rig.angle_per_count, tip))
        acc = acc + np.linalg.solve(parts.mass, force) * (command - old)
        old = command
        for _ in range(steps):
            right = (force * command + parts.mass @ (4.0 / dt**2 * x + 4.0 / dt * v + acc)
                     + parts.damping @ (2.0 / dt * x + v))
            new = np.linalg.solve(system, right)
            acc = 4.0 / dt**2 * (new - x) - 4.0 / dt * v - acc
            v, x = 2.0 / dt * (new - x) - v, new
    return np.array(rows)


def exact(rig: Rig, lumps: int, run: Run) -> np.ndarray:
    """The chain's state space under an exact hold, through the same compensator: rows of encoder and accelerometer."""
    system = control.sample_system(state_space(rig, lumped_assembly(rig, lumps)), rig.period, method="zoh")
    compensator = Compensator.from_spec(run.metadata.controller, rig.sample_rate, rig.amplifier.limit)
    x, last, rows, delay = np.zeros(system.nstates), 0.0, [], -run.metadata.command_row
    for i in range(len(run.t)):
        rows.append(system.C @ x + system.D[:, 0] * last)
        seen = rows[i - delay] if i >= delay else np.zeros(2)
        last = compensator.step(run.command[i] if compensator.open_loop else run.reference[i], *seen)
        x = system.A @ x + system.B[:, 0] * last
    return np.array(rows)


def test_run(kind: str = "open", command_row: int = 0) -> Run:
    zero = np.zeros(len(PULSES))
    return Run("test", np.arange(len(PULSES)) / 500.0, PULSES, PULSES, zero, zero,
               RunMetadata(controller=CONTROLLERS[kind], command_row=command_row))


test_run.__test__ = False


def test_the_chains_loop_is_cut_where_the_rigs_limit_for_tests_is():
    rig = load_rig("sflr").model_copy(update={"limits": Limits(command=70.0)})
    found = run_chain(rig, test_run("lead", command_row=-1), 4)
    assert (found.command.max(), found.command.min()) == (70.0, -70.0)


@given(rigs())
@settings(max_examples=30, deadline=None)
def test_transfer_matrices_step_as_newmark_on_the_assembled_chain(rig):
    lumps = 4
    chain = DiscreteChain(rig, lumps, rig.period / 2)
    rows = []
    for command in PULSES[:60]:
        rows.append(chain.readings())
        chain.advance(command, 2)
    wanted = newmark(rig, lumps, rig.period / 2, PULSES[:60], 2)
    np.testing.assert_allclose(rows, wanted, atol=1e-7 * np.abs(wanted).max())


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_converges_in_second_order_to_the_chain_state_space(kind):
    rig, run, lumps = load_rig("sflr"), test_run(kind, command_row=-1), 4
    wanted = exact(rig, lumps, run)
    errors = []
    for steps in (8, 16, 32):
        found = run_chain(rig, run, lumps, steps)
        errors.append(np.abs(np.stack([found.encoder, found.accel], axis=1) - wanted).max(axis=0))
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    np.testing.assert_allclose(orders[:, 0], 2.0, atol=0.1)
    np.testing.assert_allclose(orders[:, 1], 2.0, atol=0.25)


def test_chain_frequencies_converge_to_finite_elements_in_second_order():
    rig = load_rig("sflr")
    beam = rig.beam.model_copy(update={"elements": 40})
    wanted = natural_frequencies(rig.model_copy(update={"beam": beam}))[1:5]
    counts = np.array([20, 40, 80])
    errors = np.array([np.abs(frequencies(rig, n)[1:5] / wanted - 1.0) for n in counts])
    orders = -np.diff(np.log(errors), axis=0) / np.diff(np.log(counts))[:, None]
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert errors[-1].max() < 2e-3


def test_without_a_beam_it_is_the_rigid_axis():
    rig = load_rig("sflr").model_copy(update={key: None for key in ("clamp", "beam", "tip", "accelerometer")})
    found, wanted = run_chain(rig, test_run(), 1, 64), simulate(rig, test_run(), rounding=False, start_angle=0.0)
    np.testing.assert_allclose(found.encoder, wanted.encoder, atol=2e-4 * np.abs(wanted.encoder).max())


def test_many_lumps_and_short_steps_give_the_simulation_of_the_rig():
    rig, run = load_rig("sflr"), test_run("lead", command_row=-1)
    rig = rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": 10})})
    wanted = simulate(rig, run, rounding=False, start_angle=0.0)
    found = run_chain(rig, run, 40, 32)
    np.testing.assert_allclose(found.encoder, wanted.encoder, atol=2e-3 * np.abs(wanted.encoder).max())


def test_measured_p_step_overshoots_as_the_simulation_does():
    log = np.loadtxt(measured_log("p"))
    run = Run("p", log[:, 0], log[:, 2], log[:, 3], log[:, 4], log[:, 5],
              RunMetadata(controller=CONTROLLERS["p"], command_row=-1))
    rig = load_rig("sflr")
    found = run_chain(rig, run, 20, 8, rounding=True).encoder
    wanted = simulate(rig, run, start_angle=0.0).encoder
    assert abs(found.max() - wanted.max()) <= 1.0
    assert np.all(found == np.round(found))
