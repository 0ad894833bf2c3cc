"""Fits of one hypothesis, on runs whose constants are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.estimation.dataset import dataset
from station.estimation.fitted import Fit, weighing_of
from station.estimation.identifiability import unseen_with_effects
from station.estimation.least_squares import _Descent, fit, inherited
from station.estimation.likelihood import Weighing, rho
from station.estimation.observer import observers
from station.estimation.parameters import Hypothesis, Parameters, parameters
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.model.effects import effect_class
from station.model.simulate import simulate
from station.model.units import powers
from station.rig import load_rig
from station.runs.run import Run, RunMetadata
from tests.estimation.made import AXIS, predictions, runs_of
from tests.truth import CONTROLLERS

FRICTION, KEY = effect_class("coulomb_friction"), ("coulomb_friction", "motor")
TORQUE = 0.02 * AXIS.motor.gain * AXIS.amplifier.limit


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    true = AXIS.with_constants({"motor.damping": 1.1 * AXIS.motor.damping})
    true = true.with_effects([FRICTION(at="motor", torque=TORQUE)])
    return Predictor(dataset(AXIS, runs_of(true)), observers(AXIS, 0.0), Pool())


@pytest.fixture(scope="module")
def weighing(predictor: Predictor) -> Weighing:
    return Weighing(predictor.counts, 1.0)


@pytest.fixture(scope="module")
def fitted(predictor: Predictor, weighing: Weighing) -> Fit:
    """From three times the friction."""
    space = parameters(predictor.data, Hypothesis(((FRICTION, "motor"),)), {KEY: {"torque": 3.0 * TORQUE}})
    return fit(predictor, space, weighing, space.mean.copy(), tolerance=0.01, iterations=40)


def test_what_was_hidden_is_found_from_a_wrong_start(fitted: Fit) -> None:
    assert fitted.space.values(fitted.x)[KEY]["torque"] == pytest.approx(TORQUE, rel=0.05)
    rig = fitted.space.rig_at(fitted.x)
    ratio = rig.motor.damping / rig.motor.gain / (AXIS.motor.damping / AXIS.motor.gain)
    assert ratio == pytest.approx(1.1, rel=0.03)
    assert np.all(fitted.squares < 2.0 * block_counts_of(fitted))


def test_what_no_output_shows_carries_no_information() -> None:
    """All torques in another unit are the same outputs, and so is a beam in another unit of length (model.units):
    what derivatives along these directions leave must be nothing beside the constants' prior (1 per sigma)."""
    rig = load_rig("sflr")
    reference = np.where(np.arange(600) < 50, 0.0, 150.0)
    zero = np.zeros(600)
    still = Run("step", np.arange(600) / 500.0, reference, reference, zero, zero,
                RunMetadata(controller=CONTROLLERS["p2"], command_row=-1))
    made = simulate(rig.remeshed(), still)
    run = replace(still, command=made.command, encoder=made.encoder, accel=made.accel)
    predictor = Predictor(dataset(rig, [run]), observers(rig, 0.0), Pool())
    space = parameters(predictor.data, Hypothesis(), {})
    found = fit(predictor, space, Weighing(predictor.counts, 1.0), space.mean.copy(), iterations=0)
    normal, _ = found.normal(found.weighing)
    for unit in (0, 1):
        direction = np.linalg.solve(space.root, powers(space.paths, unit))
        assert np.diag(normal).max() > 1e4
        assert direction @ normal @ direction < 0.02 * (direction @ direction)


def test_a_law_that_bends_sharply_tells_nothing_of_the_unit_of_torque() -> None:
    """A ripple of 24 cycles per turn, exactly as it is: its size is as uncertain as the rig file's torques are."""
    ripple, cause = effect_class("torque_ripple"), ("torque_ripple", "motor")
    sizes = {"amplitude": TORQUE, "cycles": 24.0, "phase": 0.4}
    predictor = predictions(AXIS, runs_of(AXIS.with_effects([ripple(at="motor", **sizes)])))
    space = parameters(predictor.data, Hypothesis(((ripple, "motor"),)), {cause: sizes})
    found = fit(predictor, space, Weighing(predictor.counts, 1.0), space.mean.copy(), iterations=3, to_the_end=True)
    unseen = unseen_with_effects(space, found.x)[:, 0]
    normal, _ = found.normal(found.weighing)
    assert unseen @ normal @ unseen < 1e-6
    assert np.sqrt(found.covariance[space.parts["effects"].start][space.parts["effects"].start]) > 0.05


def block_counts_of(found: Fit) -> np.ndarray:
    counts = np.zeros_like(found.squares)
    np.add.at(counts, found.owner, found.information.counts)
    return counts


def test_sums_over_stretches_are_those_of_the_whole(fitted: Fit) -> None:
    info, jac = fitted.information, fitted.jacobian
    for r, (j, e) in enumerate(zip(jac, fitted.residuals, strict=True)):
        own = fitted.owner == r
        np.testing.assert_allclose(info.squares[own].sum(axis=0), fitted.squares[r], rtol=1e-10)
        np.testing.assert_allclose(info.normal[own].sum(axis=0), np.einsum("ibn,jbn->bij", j, j), rtol=1e-8)
        np.testing.assert_allclose(info.gradient[own].sum(axis=0), np.einsum("ibn,bn->bi", j, e), rtol=1e-8)


def test_drawing_every_stretch_once_changes_nothing(fitted: Fit, weighing: Weighing) -> None:
    ones, sizes = np.ones(len(fitted.owner)), np.array(weighing.differ)
    once, twice = fitted.log_evidences(weighing, sizes, np.stack([ones, 2.0 * ones]))
    assert once == pytest.approx(fitted.log_evidence(weighing), rel=1e-12)
    np.testing.assert_allclose(fitted.blocks(weighing, ones), fitted.blocks(weighing))
    assert twice != pytest.approx(once, rel=1e-3)


def test_errors_that_only_say_where_the_parameters_are_cost_nothing(fitted: Fit, weighing: Weighing) -> None:
    """What they cost is all that is missing, but for what a last step gains: the parameters are known as well."""
    quick, longest = np.array([True, False]), np.array([False, True])
    counted, other = (replace(weighing, independent=weighing.independent * blocks) for blocks in (longest, quick))
    squares, counts, independent = fitted.drawn(other, None)
    less = 0.5 * float(np.sum(independent * rho(squares / counts))) / weighing.temperature
    assert less > 10.0
    assert fitted.log_evidence(counted, weighing) == pytest.approx(fitted.log_evidence(weighing) + less, abs=0.1)
    assert fitted.log_evidence(weighing, weighing) == pytest.approx(fitted.log_evidence(weighing), rel=1e-12)


def test_resamples_and_sizes_are_worked_out_together_as_one_by_one(fitted: Fit, weighing: Weighing) -> None:
    drawn = np.random.default_rng(3).exponential(size=(4, len(fitted.owner)))
    sizes = np.array([[0.0, 0.0], [0.1, 1.0], [0.3, 0.0]])
    together = fitted.log_evidences(weighing, sizes, drawn[:, None])
    assert together.shape == (4, 3)
    for k, many in enumerate(drawn):
        for m, size in enumerate(sizes):
            assert together[k, m] == pytest.approx(float(fitted.log_evidences(weighing, size, many)), rel=1e-10)
    # A resample is the same fit to the same errors, of which some stand there so often.
    info = fitted.information
    again = replace(fitted, information=replace(info, squares=info.squares * drawn[0][:, None],
                                                counts=info.counts * drawn[0][:, None],
                                                normal=info.normal * drawn[0][:, None, None, None],
                                                gradient=info.gradient * drawn[0][:, None, None]))
    squares, counts, independent = fitted.drawn(weighing, drawn[0])
    other = replace(weighing, independent=independent)
    again = replace(again, squares=squares, counts=counts)
    assert float(again.log_evidences(other, sizes[0])) == pytest.approx(together[0, 0], rel=1e-10)


def test_eliminating_each_runs_nuisances_is_solving_for_all_at_once(fitted: Fit, weighing: Weighing) -> None:
    p, c, runs = fitted.space.size, fitted.nuisance.shape[1], len(fitted.squares)
    joint, force = np.zeros((p + runs * c, p + runs * c)), np.zeros(p + runs * c)
    w = fitted.blocks(weighing)
    for r, (j, e) in enumerate(zip(fitted.jacobian, fitted.residuals, strict=True)):
        at = np.r_[0:p, p + r * c: p + (r + 1) * c]
        joint[np.ix_(at, at)] += np.einsum("b,ibn,jbn->ij", w[r], j, j)
        force[at] += np.einsum("b,ibn,bn->i", w[r], j, e)
        own = np.arange(p + r * c, p + (r + 1) * c)
        joint[own, own] += fitted.nuisance[r]
        force[own] -= fitted.nuisance[r] * fitted.away[r]
    prior = fitted.space.precision
    joint[range(p), range(p)] += prior
    force[:p] -= prior * (fitted.x - fitted.space.mean)
    normal, slope = fitted.normal(weighing)
    step = np.linalg.solve(normal + np.diag(prior), slope - prior * (fitted.x - fitted.space.mean))
    np.testing.assert_allclose(step, np.linalg.solve(joint, force)[:p], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(normal + np.diag(prior)), np.linalg.inv(joint)[:p, :p], rtol=1e-5,
                               atol=1e-12)


def test_derivatives_are_differences_of_predictions(predictor: Predictor, fitted: Fit, weighing: Weighing) -> None:
    descent = _Descent(predictor, fitted.space, weighing, np.ones(3))
    here = descent.at(fitted.x, fitted.own)
    jac = descent.jacobian(here)
    for k in range(len(fitted.space.paths)):
        step = 1e-4    # short of the next place at which friction would hold the rig a tick sooner
        ends = []
        for way in (step, -step):
            x = fitted.x.copy()
            x[k] += way
            ends.append(predictor.runs(fitted.space, x, fitted.own))
        for r, (up, down) in enumerate(zip(*ends, strict=True)):
            central = (up - down) * descent.scale[r] / (2.0 * step)
            assert np.linalg.norm(jac[r][k] - central) < 0.05 * np.linalg.norm(central)


@pytest.mark.parametrize("farther", [1e6, np.inf, np.nan])
def test_a_step_that_runs_away_tells_no_derivative(predictor: Predictor, fitted: Fit, weighing: Weighing,
                                                   monkeypatch: pytest.MonkeyPatch, farther: float) -> None:
    """Forward it would be worth more than all that was measured: the way back tells, and where that runs away, too,
    nothing does."""
    descent = _Descent(predictor, fitted.space, weighing, np.ones(3))
    here, column = descent.at(fitted.x, fitted.own), descent.column
    around, rest = predictor.around(fitted.space, fitted.x), np.zeros_like(descent.scale[0])
    assert descent.small(0, 0.9 * descent.measured[0] * descent.scale[0]) and descent.small(0, rest)
    honest, moved = column(around, here, 1), Predictor.runs

    def runs(self: Predictor, space: Parameters, x: np.ndarray, own: np.ndarray) -> list[np.ndarray]:
        away = farther if x[1] > fitted.x[1] or both else 0.0
        return [y + away for y in moved(self, space, x, own)]

    monkeypatch.setattr(Predictor, "runs", runs)
    for both in (False, True):
        for told, before in zip(column(around, here, 1), honest, strict=True):
            assert np.linalg.norm(told - before) < 0.2 * np.linalg.norm(before) if not both else not told.any()


def test_a_run_of_weight_0_does_not_pull(predictor: Predictor, fitted: Fit, weighing: Weighing) -> None:
    descent = _Descent(predictor, fitted.space, weighing, np.array([1.0, 0.0, 1.0]))
    here = descent.at(fitted.x, fitted.own)
    jac = [j.copy() for j in fitted.jacobian]
    before = descent.normal(here, jac)[:2]
    jac[1] *= 3.0
    for one, other in zip(before, descent.normal(here, jac)[:2], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6 * np.abs(one).max())


def test_derivatives_that_are_handed_on_are_the_same_in_other_coordinates(predictor: Predictor, fitted: Fit) -> None:
    wider = parameters(predictor.data, fitted.space.hypothesis + Hypothesis((), ("motor.gain",)),
                       fitted.space.values(fitted.space.mean))
    n = len(wider.paths)
    for old, new in zip(fitted.jacobian, inherited(fitted, wider), strict=True):
        by_log = np.tensordot(np.linalg.inv(fitted.space.root).T, old[:n], 1)
        np.testing.assert_allclose(np.tensordot(np.linalg.inv(wider.root).T, new[:n], 1), by_log, rtol=1e-7, atol=1e-9)
        assert not new[n: wider.size].any() and np.array_equal(new[wider.size:], old[fitted.space.size:])


def test_where_a_model_reaches_the_noise_errors_are_nearly_all_independent(predictor: Predictor, fitted: Fit) -> None:
    found = weighing_of(predictor, fitted)
    assert found.temperature >= 1.0 and np.all(found.independent <= block_counts_of(fitted) + 1e-9)


def test_a_start_that_does_not_simulate_is_refused(predictor: Predictor, fitted: Fit, weighing: Weighing) -> None:
    """An angle that is not a number stands for a model that has run away."""
    with pytest.raises(ArithmeticError, match="does not simulate"):
        fit(predictor, fitted.space, weighing, fitted.x, own=np.full((3, 4), np.nan))


def test_zeros_that_are_moved_in_all_runs_at_once_move_each_run_by_its_own() -> None:
    pendulum = AXIS.with_effects([effect_class("gravity_tilt")(at="base", torque=0.05, angle=0.0)])
    runs = [replace(run, metadata=run.metadata.model_copy(update={"zero_id": name}))
            for run, name in zip(runs_of(pendulum), ("bench", "other", "bench"), strict=True)]
    predictor = Predictor(dataset(pendulum, runs), observers(pendulum, 0.0), Pool())
    space = parameters(predictor.data, Hypothesis(), {})
    descent = _Descent(predictor, space, Weighing(predictor.counts, 1.0), np.ones(3))
    here = descent.at(space.mean, predictor.data.own)
    jacobian, first = descent.jacobian(here), space.parts["zeros"].start
    for group in (0, 1):
        for r, alone in enumerate(descent.columns(here, np.array([first + group]))[0]):
            np.testing.assert_array_equal(jacobian[r][first + group], alone)
            assert np.any(alone) == (predictor.data.zero_groups[r] == group)
