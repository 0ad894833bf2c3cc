"""A fitted hypothesis: what the data say about its parameters, and its evidence under any weighing and any resample."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from station.estimation.differing import Differing
from station.estimation.likelihood import (
    Weighing,
    block_weights,
    cost,
    differ_ends,
    differ_precision,
    rho,
    temperatures,
)
from station.estimation.parameters import Parameters
from station.estimation.prediction import Predictor

GRID = 7
"""Sizes of either kind, two units of the logarithm apart: the search for the most likely begins at their best pair."""
SIZES = 30
"""Sizes, evenly spaced in the logarithm, over which a density is averaged: half a unit apart."""
REWEIGHED = 3
"""Times that a step which is not simulated is weighed anew by what it would leave."""
MOST_GAINED = 20.0
"""What a step that is not simulated may be expected to gain of the data's part of the objective."""


@dataclass(frozen=True, eq=False)
class Information:
    """What the data say about the parameters near a fit, by stretch s of time and block b: any weights, any resample.

    Columns of J: the p parameters, then what the stretch's run has of its own.
    """

    squares: np.ndarray
    """(s, b) sum of squared scaled errors."""
    counts: np.ndarray
    """(s, b) independent errors of the sensors."""
    normal: np.ndarray
    """(s, b, p + c, p + c) J'J."""
    gradient: np.ndarray
    """(s, b, p + c) J'e."""


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters, what runs have of their own, and how well they predict."""

    x: np.ndarray
    own: np.ndarray
    """(runs, 4) what each run has of its own (``Dataset.own``)."""
    predicted: list[np.ndarray]
    """Per run (b, n), counts."""
    residuals: list[np.ndarray]
    """Per run (b, n), scaled."""
    squares: np.ndarray
    """(runs, b) sums of squared scaled errors."""
    objective: float
    """-2 ln of likelihood (tempered) times priors."""


@dataclass(frozen=True, eq=False)
class Fit(Point):
    """A fitted hypothesis."""

    space: Parameters
    away: np.ndarray
    """(runs, c) what runs have of their own, as far as it is free, from where it was before the fit."""
    counts: np.ndarray
    """(runs, b) independent errors of the sensors."""
    jacobian: list[np.ndarray] | None
    """Per run (p + c, b, n), scaled; None where it was let go."""
    information: Information
    weighing: Weighing
    nuisance: np.ndarray
    """(runs, c) prior precisions of what runs have of their own."""
    owner: np.ndarray
    """(s) the run of each stretch."""

    @property
    def key(self) -> frozenset[tuple[str, str]]:
        """The causes."""
        return self.space.hypothesis.key

    @property
    def alone(self) -> bool:
        """Whether it is of one run, which differs from no other (``Dataset.free``)."""
        return len(self.nuisance) == 1

    @property
    def misfit(self) -> float:
        """Mean squared error of the predictions, in units of the noise; 1 where nothing but noise is left."""
        return float(self.squares.sum() / self.counts.sum())

    @property
    def log_constants(self) -> float:
        """Log density of what the rig file states within an uncertainty under its prior, up to a number that all
        hypotheses share."""
        w, held = (self.x[self.space.parts[part]] for part in ("constants", "held"))
        return (-0.5 * float(w @ w + held @ held) - float(np.linalg.slogdet(self.space.root)[1])
                - sum(math.log(one.sigma) for one in self.space.held))

    @property
    def light(self) -> Fit:
        """The same without derivatives, which take memory."""
        return replace(self, jacobian=None)

    def only(self, blocks: np.ndarray) -> Fit:
        """The same with some of its blocks, ``blocks`` (b): whether each is kept."""
        info, jacobian, weighing = self.information, self.jacobian, self.weighing
        return replace(
            self, predicted=[y[blocks] for y in self.predicted], residuals=[e[blocks] for e in self.residuals],
            squares=self.squares[:, blocks], counts=self.counts[:, blocks],
            jacobian=jacobian and [j[:, blocks] for j in jacobian],
            information=Information(*(each[:, blocks] for each in vars(info).values())),
            weighing=replace(weighing, independent=weighing.independent[:, blocks]))

    def blocks(self, weighing: Weighing, drawn: np.ndarray | None = None) -> np.ndarray:
        """(..., runs, b) weights W of the blocks at this fit; ``drawn`` (..., s): how often each stretch counts in each
        resample."""
        return block_weights(*self.drawn(weighing, drawn)) / weighing.temperature

    def drawn(self, weighing: Weighing, drawn: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squares, counts and independent errors (..., runs, b) of resamples."""
        info, many = self.information, 1.0 if drawn is None else drawn[..., None]
        counts = np.maximum(self._summed(many * info.counts), 1e-9)
        independent = weighing.independent * counts / np.maximum(self._summed(info.counts), 1e-9)
        return self._summed(many * info.squares), counts, independent

    def normal(self, weighing: Weighing, drawn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (p, p) and gradient (p) of the data, what runs have of their own eliminated."""
        normals, gradients = self.run_normals(weighing, drawn)
        return normals.sum(axis=0), gradients.sum(axis=0)

    def run_normals(self, weighing: Weighing, drawn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The same run by run: (runs, p, p) and (runs, p)."""
        return self._eliminated(*self._by_run(weighing, drawn), self.own_precision(weighing.differ))[:2]

    def own_precision(self, sizes: tuple[float, float] | np.ndarray) -> np.ndarray:
        """(..., runs, c) prior precisions of what runs have of their own where they differ by ``sizes`` (..., 2)."""
        differ = np.asarray(sizes, dtype=float)
        found = np.broadcast_to(self.nuisance, (*differ.shape[:-1], *self.nuisance.shape)).copy()
        if not self.alone:
            found[..., -2:] = differ_precision(self.space.rig, differ)[..., None, :]
        return found

    def _by_run(self, weighing: Weighing, drawn: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """J'WJ (..., runs, p + c, p + c) and J'We (..., runs, p + c)."""
        w, info = self.blocks(weighing, drawn), self.information
        if drawn is None:
            normals, slopes = self.by_block
            return np.einsum("rb,rbij->rij", w, normals), np.einsum("rb,rbi->ri", w, slopes)
        w = w[..., self.owner, :] * drawn[..., None]
        return (np.stack([np.tensordot(w[..., own, :], info.normal[own], 2) for own in self._owned], axis=-3),
                np.stack([np.tensordot(w[..., own, :], info.gradient[own], 2) for own in self._owned], axis=-2))

    @cached_property
    def by_block(self) -> tuple[np.ndarray, np.ndarray]:
        """J'J (runs, b, p + c, p + c) and J'e (runs, b, p + c), not yet weighed."""
        info = self.information
        normals, slopes = (np.stack([each[owned].sum(axis=0) for owned in self._owned])
                           for each in (info.normal, info.gradient))
        return normals, slopes

    @cached_property
    def _owned(self) -> np.ndarray:
        """(runs, s) whether a stretch is a run's."""
        return self.owner == np.arange(len(self.squares))[:, None]

    def _summed(self, stretches: np.ndarray) -> np.ndarray:
        """Sums (..., runs, b) over the stretches (..., s, b) of each run."""
        return self._owned.astype(float) @ stretches

    def _eliminated(self, matrices: np.ndarray, slopes: np.ndarray, own: np.ndarray,
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal matrices and gradients of the parameters alone, run by run; (..., runs, c, c) the inverse precisions
        of what runs have of their own at given parameters, and (..., runs, c) their forces."""
        p = self.space.size
        inverse = np.linalg.inv(matrices[..., p:, p:] + own[..., None] * np.eye(own.shape[-1]))
        force = slopes[..., p:] - own * self.away
        across = matrices[..., :p, p:] @ inverse
        return (matrices[..., :p, :p] - across @ matrices[..., p:, :p],
                slopes[..., :p] - (across @ force[..., None])[..., 0], inverse, force)

    def _stepped(self, matrices: np.ndarray, slopes: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One Gauss-Newton step from the fit, for each of the prior precisions ``own`` (..., runs, c): the step
        (..., runs, p + c), and ln of the squared volume that the data leave of the priors' there (...)."""
        p, prior = self.space.size, self.space.precision
        normals, gradients, inverse, force = self._eliminated(matrices, slopes, own)
        matrix = normals.sum(axis=-3) + np.diag(prior)
        force_on_all = gradients.sum(axis=-2) - prior * (self.x - self.space.mean)
        step = np.linalg.solve(matrix, force_on_all[..., None])[..., 0]
        back = matrices[..., p:, :p] @ step[..., None, :, None]
        moved = (inverse @ (force[..., None] - back))[..., 0]
        volume = (np.sum(np.log(prior)) - np.linalg.slogdet(matrix)[1]
                  + np.sum(np.log(own), axis=(-2, -1)) + np.sum(np.linalg.slogdet(inverse)[1], axis=-1))
        shared = np.broadcast_to(step[..., None, :], (*moved.shape[:-1], p))
        return np.concatenate([shared, moved], axis=-1), volume

    def _strained(self, step: np.ndarray, own: np.ndarray) -> np.ndarray:
        """(...) -2 ln of the priors a step (..., runs, p + c) from the fit."""
        p = self.space.size
        return ((self.x + step[..., 0, :p] - self.space.mean) ** 2 @ self.space.precision
                + np.sum(own * (self.away + step[..., p:]) ** 2, axis=(-2, -1)))

    def _differing(self, weighing: Weighing) -> Differing:
        """What the runs say of what they differ by, all else integrated out by Laplace's approximation at the fit."""
        p, (matrices, slopes), (runs, c) = self.space.size, self._by_run(weighing), self.nuisance.shape
        prior = np.concatenate([self.space.precision, self.nuisance.ravel()])
        whole, force = np.zeros((len(prior), len(prior))), np.zeros(len(prior))
        own = p + np.arange(runs * c).reshape(runs, c)
        for one, matrix, slope in zip(own, matrices, slopes, strict=True):
            at = np.concatenate([np.arange(p), one])
            whole[np.ix_(at, at)] += matrix
            force[at] += slope
        sought = own[:, -2:].ravel()
        prior[sought] = 0.0
        other = np.delete(np.arange(len(prior)), sought)
        whole += np.diag(prior)
        force -= prior * np.concatenate([self.x - self.space.mean, self.away.ravel()])
        across = whole[np.ix_(sought, other)]
        taken = np.linalg.solve(whole[np.ix_(other, other)], np.column_stack([across.T, force[other]]))
        return Differing(self.space.rig, whole[np.ix_(sought, sought)] - across @ taken[:, :-1],
                         force[sought] - across @ taken[:, -1], self.away[:, -2:].ravel())

    def most_likely_differ(self, weighing: Weighing) -> tuple[float, float]:
        """How much runs differ in what the motor does more than the rig says (``Weighing.differ``), where they may.

        Empirical Bayes (Gelman et al., section 13.6), about the fit: of highest marginal likelihood, parameters and
        what runs have of their own integrated out.  It has more than one mode: where all runs of a fit have moved the
        same way, a gain that differs stands in for one that is off.  So the best point of a grid is where it begins.
        """
        if self.alone:
            return 0.0, 0.0
        (least, largest), may = differ_ends(self.space.rig), weighing.may
        if not any(may):
            return float(least[0]), float(least[1])
        differing = self._differing(weighing)
        ends = np.log([least, np.where(may, largest, least)])
        steps = [np.unique(np.linspace(low, high, GRID)) for low, high in ends.T]
        grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
        begun = grid[np.argmax(differing.log_likelihoods(np.exp(grid)))]
        sizes = np.exp(minimize(differing.surprise, begun, jac=True, method="L-BFGS-B", bounds=ends.T).x)
        return float(sizes[0]), float(sizes[1])

    def log_narrowing(self, weighing: Weighing) -> np.ndarray:
        """(2) ln of the evidence, averaged over what runs may differ by in either, over that at ``weighing.differ``.

        Of a set's sizes only the order of magnitude is unknown beforehand: their logarithms are evenly distributed
        (Gelman et al., section 5.4), down to where runs are alike.  Sizes that the runs single out were one of many; a
        set that needs none has most of them.  The other size stays at its most likely.
        """
        if self.alone:
            return np.zeros(2)
        sizes = np.tile(weighing.differ, (2, SIZES, 1))
        ends = np.log(differ_ends(self.space.rig))
        for k, logs in enumerate(np.linspace(ends[0], ends[1], SIZES).T):
            sizes[k, :, k] = np.exp(logs)
        log_density = self._differing(weighing).log_likelihoods(np.vstack([weighing.differ, *sizes]))
        others = np.minimum(log_density[1:] - log_density[0], 0.0).reshape(2, SIZES)
        return np.log(np.trapezoid(np.exp(others), axis=1) / (SIZES - 1))

    def log_expected(self, weighing: Weighing) -> float:
        """Log evidence that a fit under another weighing is expected to reach, however far from here it ends.

        Predictions are taken for linear, the cost is the likelihood's own: its least is sought by weighing the blocks
        anew by what they would leave (majorisation: Hunter and Lange, The American Statistician 58, 2004).  Of the
        difference it misses a seventh, and two fifths where nothing holds the rig's cause (14 sets on three made rigs).
        """
        squares, counts, left = self.squares, self.counts, self.squares
        own, (normals, slopes) = self.own_precision(weighing.differ), self.by_block
        for _ in range(REWEIGHED):
            w = block_weights(left, counts, weighing.independent) / weighing.temperature
            whole, volume = self._stepped(np.einsum("rb,rbij->rij", w, normals),
                                              np.einsum("rb,rbi->ri", w, slopes), own)
            left = np.maximum(squares - 2.0 * np.einsum("rbi,ri->rb", slopes, whole)
                              + np.einsum("ri,rbij,rj->rb", whole, normals, whole), 0.0)
        price = cost(left, counts, weighing.independent) / weighing.temperature
        return float(0.5 * (volume - self._strained(whole, own) - price))

    @cached_property
    def covariance(self) -> np.ndarray:
        """Posterior covariance (p, p) under the fit's own weighing."""
        return np.linalg.pinv(self.normal(self.weighing)[0] + np.diag(self.space.precision), hermitian=True)

    def log_evidence(self, weighing: Weighing, found_by: Weighing | None = None) -> float:
        """Laplace's approximation of ln p(data | hypothesis), up to a constant of the data.

        Under another weighing one Gauss-Newton step is taken from the fit.  ``found_by``: by what errors say where the
        parameters are, where some of them say that and no more.
        """
        return float(self.log_evidences(weighing, np.array(weighing.differ), None, found_by))

    def log_evidences(self, weighing: Weighing, sizes: np.ndarray, drawn: np.ndarray | None = None,
                      found_by: Weighing | None = None) -> np.ndarray:
        """(...) the same where runs differ by ``sizes`` (..., 2) in place of ``weighing.differ`` and stretches count as
        often as ``drawn`` (..., s) says; the two are broadcast."""
        squares, counts, independent = self.drawn(weighing, drawn)
        (matrices, slopes), own = self._by_run(found_by or weighing, drawn), self.own_precision(sizes)
        step, volume = self._stepped(matrices, slopes, own)
        if found_by is not None:
            matrices, slopes = self._by_run(weighing, drawn)
        gained = np.sum(step * (2.0 * slopes - (matrices @ step[..., None])[..., 0]), axis=(-2, -1))
        costs = np.sum(independent * rho(squares / counts), axis=(-2, -1))
        return 0.5 * (volume - (self._strained(step, own) - np.minimum(gained, MOST_GAINED))
                      - costs / weighing.temperature)


def weighing_of(predictor: Predictor, found: Fit, counted: np.ndarray | None = None) -> Weighing:
    """What the blocks count for where a fit's errors are taken for what a model of this rig leaves; ``counted`` (b):
    those that do, all by default."""
    independent = predictor.independent(found.squares, found.residuals)
    cold = replace(found.weighing, independent=independent if counted is None else independent * counted,
                   temperature=1.0)
    kinds, whole = temperatures(*_projected(found, cold), found.space.precision)
    warm = replace(cold, independent=cold.independent / kinds, temperature=whole)
    return replace(warm, differ=found.most_likely_differ(warm))


def _projected(found: Fit, weighing: Weighing) -> tuple[np.ndarray, np.ndarray]:
    """(b, p, p) the likelihood's curvature, of every kind of block, and (s, b, p) its slopes in every stretch, what
    runs have of their own eliminated."""
    info, p = found.information, found.space.size
    w = found.blocks(weighing)[found.owner]
    curvatures, slopes = np.zeros((w.shape[1], p, p)), np.zeros((*w.shape, p))
    owns = found.own_precision(weighing.differ)
    for r in range(len(found.squares)):
        own = found.owner == r
        matrices, forces = np.einsum("sb,sbij->bij", w[own], info.normal[own]), w[own, :, None] * info.gradient[own]
        whole = matrices.sum(axis=0)
        take = np.linalg.solve(whole[p:, p:] + np.diag(owns[r]), whole[p:, :p])
        kept = np.vstack([np.eye(p), -take])
        curvatures += kept.T @ matrices @ kept
        slopes[own] = forces @ kept
    return curvatures, slopes
