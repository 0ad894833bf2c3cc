"""The density that fits predict of a run that they left out, and what that says for and against causes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from station.diagnose.thresholds import UNSEEN
from station.estimation.fitted import Fit
from station.estimation.least_squares import STEP, correct, own_steps
from station.estimation.likelihood import Weighing, block_weights, cost
from station.estimation.prediction import Predictor
from station.estimation.spread import between_runs

OWN_STEPS = 8
"""Most steps to what a run has of its own."""


@dataclass(frozen=True, eq=False)
class Predicted:
    """What a fit that left a run out predicts of it."""

    log_density: float
    """ln of the density of the run, up to a number that all fits share."""
    errors: np.ndarray
    """(b, n) of the most likely prediction, in units of the noise."""


def predicted(predictor: Predictor, weighing: Weighing, left: Fit, run: int) -> Predicted:
    """The density that a fit, which left a run out, predicts of that run, and the errors.

    A log pointwise predictive density (Vehtari, Gelman and Gabry, Stat. Comput. 27, 2017) of a group of data with
    parameters of its own: what the run has of its own and all that the other runs leave open (``differing``) are
    integrated out, about their most likely values, by Laplace's approximation.
    """
    data, space = predictor.data, left.space
    measured, scale = predictor.measured(run), predictor.scale(run)
    counts, independent = predictor.counts[run], weighing.independent[run]
    directions = differing(left, run)
    free = len(data.free)
    steps = np.concatenate([own_steps(data)[data.free], np.full(len(directions), STEP)])
    prior = np.concatenate([left.own_precision(left.weighing.differ)[run], np.ones(len(directions))])
    first = np.concatenate([data.own[run][data.free], np.zeros(len(directions))])
    count = data.rig.angle_per_count

    def errors(moved: np.ndarray) -> np.ndarray:
        own = left.own[run].copy()
        own[data.free] = moved[:free]
        x = left.x + moved[free:] @ directions
        return (measured - predictor.some(predictor.model(space, x), space, x, [run], own[None])[0]) * scale

    def surprise(e: np.ndarray, moved: np.ndarray) -> float:
        return (cost(np.sum(e * e, axis=1), counts, independent) / weighing.temperature
                + float(prior @ (moved - first) ** 2))

    at = np.concatenate([left.own[run][data.free], np.zeros(len(directions))])
    here = errors(at)
    value = surprise(here, at)
    if not np.isfinite(value):
        return Predicted(-math.inf, here)
    columns = np.zeros((len(at), *here.shape))
    for k in range(OWN_STEPS):
        for i in range(free if k else len(at)):     # the others: by ``correct``, below
            columns[i] = (here - errors(at + steps[i] * (np.arange(len(at)) == i))) / steps[i]
        weights = block_weights(np.sum(here * here, axis=1), counts, independent) / weighing.temperature
        matrix = np.einsum("ibn,b,jbn->ij", columns, weights, columns) + np.diag(prior)
        step = np.linalg.solve(matrix, np.einsum("ibn,b,bn->i", columns, weights, here) - prior * (at - first))
        for share in (1.0, 0.3, 0.1):
            moved = at + share * step
            moved[0] = np.clip(moved[0], data.own[run, 0] - count, data.own[run, 0] + count)
            there = errors(moved)
            fell = value - surprise(there, moved)
            if fell > 0.0:
                correct(columns, moved - at, prior, here - there)
                at, here, value = moved, there, value - fell
                break
        if not fell > 0.1:
            break
    return Predicted(-0.5 * (value + float(np.linalg.slogdet(matrix)[1]) - float(np.sum(np.log(prior)))), here)


def differing(left: Fit, run: int) -> np.ndarray:
    """(p, p) along what the parameters of a run that was left out may differ from the fit of the others, one standard
    deviation each: they are known as well as those runs say, and a cause's sizes differ as much as they do there."""
    space, others = left.space, (left.owner != run).astype(float)
    effects = space.parts["effects"]
    ways = [*(space.along_log(path) for path in space.hypothesis.constants), *np.eye(space.size)[effects]]
    spread = np.array([between_runs(left, way, others).size * way for way in ways]).reshape(len(ways), space.size)
    known = left.normal(left.weighing, others)[0] + np.diag(space.precision)
    variances, along = np.linalg.eigh(np.linalg.inv(known) + spread.T @ spread)
    return (along * np.sqrt(np.maximum(variances, 0.0))).T


def all_predicted(predictor: Predictor, weighing: Weighing, left_out: Sequence[Fit]) -> list[Predicted]:
    """Every run by the fit that left it out."""
    return list(predictor.pool.map(lambda r: predicted(predictor, weighing, left_out[r], r), range(len(left_out))))


def log_densities(found: Sequence[Predicted]) -> np.ndarray:
    """(runs) ln of the density of every run."""
    return np.array([one.log_density for one in found])


def information(predictor: Predictor, weighing: Weighing, without: Sequence[Predicted], found: Sequence[Predicted],
                ) -> np.ndarray:
    """(runs) by how much causes would raise the log density of each run left out if they were right: by what they
    change in its prediction, whatever was measured.

    Half the rise of -2 ln L where the change is added to errors that have nothing to do with it.
    """
    def rise(r: int) -> float:
        counts, independent = predictor.counts[r], weighing.independent[r]
        left = np.sum(found[r].errors ** 2, axis=1)
        change = np.sum((without[r].errors - found[r].errors) ** 2, axis=1)
        return cost(left + change, counts, independent) - cost(left, counts, independent)
    with np.errstate(invalid="ignore"):     # a run that does not simulate
        return np.array([rise(r) for r in range(len(found))]) / (2.0 * weighing.temperature)


def unseen_gain(weighing: Weighing, gains: np.ndarray) -> float:
    """What causes raise the log densities of unseen runs by (runs), as a share of their errors: 1 - exp(-gain per
    independent error)."""
    independent = float(weighing.independent.sum()) / weighing.temperature
    return -math.expm1(-float(gains.sum()) / max(independent, 1e-300))


def standard_error(gains: np.ndarray, informed: np.ndarray) -> float:
    """Of the sum of what causes raise the log densities of unseen runs by (runs), from what each run could say
    (``information``, runs).

    A run that the causes hardly change cannot gain by them, and that it does not speaks neither for nor against: gains
    are taken to be in proportion to the information, and scatter about that (the ratio estimator: Cochran, Sampling
    Techniques, 3rd ed. 1977, section 6.4).  A log likelihood ratio itself has twice its mean for a variance, where the
    causes are right; that is the least.
    """
    with np.errstate(invalid="ignore", divide="ignore"):     # a run that does not simulate
        total = float(informed.sum())
        apart = gains - (gains.sum() / total if total > 0.0 else 0.0) * informed
        return math.sqrt(max(float(apart @ apart) * len(gains) / (len(gains) - 1), 2.0 * total))


def contradicted(gains: np.ndarray, informed: np.ndarray, relieved: float) -> bool:
    """Whether unseen runs (gains, and what each could say, runs), with what the rig file states of its constants, speak
    against causes: together they are not met better than by a refit alone by UNSEEN standard errors."""
    allowed = UNSEEN * standard_error(gains, informed)
    return not float(gains.sum()) + relieved >= allowed     # what is no number does not help


def relief(without: Sequence[Fit], found: Sequence[Fit]) -> float:
    """By how much causes raise the log prior density of the rig's constants, mean of fits that leave run after run out.

    What a rig file states of its constants was measured, too: a refit that meets the runs by straining them has not met
    all that is known.
    """
    return float(np.mean([after.log_constants - before.log_constants
                          for before, after in zip(without, found, strict=True)]))
