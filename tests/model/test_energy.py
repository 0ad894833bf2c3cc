"""The linear plant in time: energy, independence of the step, and the stated error of leaving modes out."""

import numpy as np
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from station.model.assembly import assemble
from station.model.effects.coulomb_friction import CoulombFriction
from station.model.linear import sampled
from station.model.modal import apply
from station.model.simulate import build, simulate_model
from station.runs.run import Run, RunMetadata
from tests.model.random_rigs import rigs

SEEDS = st.integers(0, 2**32 - 1)
PULSE = np.concatenate([np.zeros(3), np.full(25, 150.0), np.zeros(20), np.full(30, -90.0), np.zeros(60)])


def pulse_run() -> Run:
    zero = np.zeros(len(PULSE))
    return Run("pulse", np.arange(len(PULSE)) / 500.0, PULSE, PULSE, zero, zero, RunMetadata())


def energies(rig, seed: int, periods: int) -> np.ndarray:
    """Total energy (J) at each tick, by the decoupled form that the stepper uses, from a random state at rest."""
    parts, model = assemble(rig), build(rig, truncation=0.0)
    n, form = parts.size, model.form
    rng = np.random.default_rng(seed)
    x = np.concatenate([0.1 * rng.standard_normal(n), np.zeros(n)])
    # Shapes of the lowest few frequencies, as a moving rig has; the highest would hold all the energy.
    shapes = scipy.linalg.eigh(parts.stiffness, parts.mass)[1][:, :min(n, 5)]
    x[:n] = shapes @ (shapes.T @ parts.mass @ x[:n])
    z, phi, out = form.inverse @ x, form.exponential(rig.period), []
    for _ in range(periods):
        x = form.basis @ z
        out.append(0.5 * x[:n] @ parts.stiffness @ x[:n] + 0.5 * x[n:] @ parts.mass @ x[n:])
        z = apply(phi, z)
    return np.array(out)


@given(rigs(damped=False), SEEDS)
@settings(max_examples=60, deadline=None)
def test_energy_is_conserved_without_damping_and_input(rig, seed):
    found = energies(rig, seed, 300)
    np.testing.assert_allclose(found, found[0], rtol=1e-6, atol=1e-12)


@given(rigs(), SEEDS)
@settings(max_examples=60, deadline=None)
def test_energy_never_grows_with_damping(rig, seed):
    found = energies(rig, seed, 300)
    assert np.all(np.diff(found) <= 1e-9 * found[0] + 1e-15)


@given(rigs())
@settings(max_examples=25, deadline=None)
def test_sampled_plant_never_gains_energy_from_any_state(rig):
    parts, phi = assemble(rig), sampled(rig).A
    energy = scipy.linalg.block_diag(parts.stiffness, parts.mass)
    lost = energy - phi.T @ energy @ phi
    scale = np.sqrt(np.where(np.diag(energy) > 0.0, np.diag(energy), 1.0))
    assert np.linalg.eigvalsh(lost / np.outer(scale, scale)).min() > -1e-6


@given(rigs())
@settings(max_examples=15, deadline=None)
def test_linear_plant_does_not_depend_on_the_step(rig):
    within = CoulombFriction(at="motor", torque=0.0)
    models = [build(r, truncation=0.0) for r in (rig, rig.with_effects([within]))]
    assert models[1].plan.substeps > models[0].plan.substeps == 1
    one, many = (simulate_model(model, pulse_run(), rounding=False) for model in models)
    np.testing.assert_allclose(many.encoder, one.encoder, atol=1e-6 * np.abs(one.encoder).max())


@given(rigs(most_elements=20))
@settings(max_examples=25, deadline=None)
def test_modes_left_out_cost_less_than_the_stated_bound(rig):
    run, whole, cut, usual = pulse_run(), build(rig, truncation=0.0), build(rig, truncation=0.5), build(rig)
    exact = simulate_model(whole, run, rounding=False)
    assert cut.dropped <= 0.5 and usual.dropped <= 0.01
    assert cut.form.blocks <= usual.form.blocks <= whole.form.blocks
    for model in (cut, usual):
        found = simulate_model(model, run, rounding=False)
        for channel in ("encoder", "accel"):
            full, short = getattr(exact, channel), getattr(found, channel)
            if full is not None:
                assert np.abs(short - full).max() <= model.dropped + 1e-6 * np.abs(full).max()
