"""A fitted hypothesis to first order: what a change of its predictions would buy, its own parameters eliminated.

With D what a change of size 1 does to the predictions and e the errors, both weighed by W, and the parent's parameters
and nuisances taken out of both, G = D'D and b = D'e: sizes a = G^-1 b lower -2 ln L by b'G^-1 b.

A block's -2 ln L is N rho(S/n), and rho is concave.  So at any S1

    rho(S/n) <= rho(S1/n) + (S - S1)/max(S1, n),

and every quadratic whose weights are W = N/max(S1, n) promises no more than the likelihood does (majorisation: Hunter
and Lange, The American Statistician 58, 2004).  S1 is what the parent leaves, or what the change itself would leave: a
run that rests, in which the change makes something move, is met without any error and counts by the first as if its
noise were all that may be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from station.estimation.fitted import Fit
from station.estimation.likelihood import block_weights, cost
from station.estimation.parameters import Parameters
from station.estimation.prediction import Predictor


def _block_products(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> np.ndarray:
    """(runs, b) sums of the products of two, per run (b, n)."""
    return np.array([np.sum(a * b, axis=1) for a, b in zip(one, other, strict=True)])


@dataclass(frozen=True, eq=False)
class Change:
    """What is changed in the predictions; b blocks, k parameters and nuisances of the parent."""

    scaled: list[np.ndarray]
    """Per run (b, n), scaled as errors are."""
    squares: np.ndarray
    """(runs, b) c'c."""
    slopes: np.ndarray
    """(runs, b, k) J'c."""

    @staticmethod
    def combined(changes: Sequence[Change], sizes: np.ndarray) -> Change:
        """So many times (m) each of m changes."""
        if len(changes) == 1 and sizes[0] == 1.0:
            return changes[0]
        scaled = [sum(a * c for a, c in zip(sizes, run, strict=True))
                  for run in zip(*(c.scaled for c in changes), strict=True)]
        return Change(scaled, _block_products(scaled, scaled), np.tensordot(sizes, [c.slopes for c in changes], 1))


@dataclass(frozen=True, eq=False)
class Linearised:
    """A parent's errors and derivatives, block by block."""

    predictor: Predictor
    parent: Fit
    errors: list[np.ndarray]
    """Per run (b, n), scaled."""
    squares: np.ndarray
    """(runs, b) e'e."""
    gradient: np.ndarray
    """(runs, b, k) J'e."""
    kept: list[int]
    """The parent's parameters that are there."""

    @staticmethod
    def of(predictor: Predictor, parent: Fit) -> Linearised:
        """About a fit that has its derivatives."""
        return Linearised(predictor, parent, parent.residuals, parent.squares, parent.by_block[1],
                          list(range(parent.space.size)))

    def without(self, reduced: Parameters) -> Linearised:
        """With one effect less; what that does is put back into the errors.

        ArithmeticError: without it the rig does not simulate.
        """
        change = self.change(reduced, reduced.carried(self.parent.space, self.parent.x))
        if change is None:
            raise ArithmeticError("without this effect the rig does not simulate")
        names = set(reduced.names())
        errors = [e - c for e, c in zip(self.errors, change.scaled, strict=True)]
        kept = [i for i, name in enumerate(self.parent.space.names()) if name in names]
        return replace(self, errors=errors, squares=_block_products(errors, errors),
                       gradient=self.gradient - change.slopes, kept=kept)

    def change(self, space: Parameters, x: np.ndarray) -> Change | None:
        """What a hypothesis at ``x`` changes in the parent's predictions; None where it does not simulate, or runs away
        so far that nothing can be worked out with it."""
        parent, predictor = self.parent, self.predictor
        assert parent.jacobian is not None
        with np.errstate(over="ignore", invalid="ignore"):
            found = [(new - old) * predictor.scale(r) for r, (new, old) in
                     enumerate(zip(predictor.runs(space, x, parent.own), parent.predicted, strict=True))]
            squares = _block_products(found, found)
            slopes = np.array([(j.transpose(1, 0, 2) @ c[:, :, None])[..., 0]
                               for j, c in zip(parent.jacobian, found, strict=True)])
            beyond = not np.isfinite(squares * squares).all() or not np.isfinite(slopes * slopes).all()
        return None if beyond else Change(found, squares, slopes)

    def by_errors(self, change: Change) -> np.ndarray:
        """(runs, b) c'e."""
        return _block_products(change.scaled, self.errors)

    @cached_property
    def weighed(self) -> Weighed:
        """By what the parent leaves."""
        return Weighed(self, self.parent.blocks(self.parent.weighing))

    @cached_property
    def ahead(self) -> Weighed:
        """By what the parent leaves a few samples ahead alone, where that counts."""
        short = ~self.predictor.longest
        return Weighed(self, self.weighed.weights * short) if short.any() else self.weighed

    @property
    def weighings(self) -> list[Weighed]:
        """By all that counts, and by what is a few samples ahead, if that is another."""
        return [self.weighed, *([self.ahead] if self.ahead is not self.weighed else [])]

    def beyond(self, change: Change) -> tuple[float, float, float] | None:
        """What -2 ln L falls by before the change's size is chosen, G and b, weighed by what the change would leave.

        None where it stays within the errors that the parent leaves, and the parent's weights hold.
        """
        parent, weighing = self.parent, self.parent.weighing
        if np.all(change.squares <= np.maximum(self.squares, parent.counts)):
            return None
        there = np.maximum(self.squares - 2.0 * self.by_errors(change) + change.squares, 0.0)
        weighed = Weighed(self, block_weights(there, parent.counts, weighing.independent) / weighing.temperature)
        fall = (cost(self.squares, parent.counts, weighing.independent)
                - cost(there, parent.counts, weighing.independent)) / weighing.temperature
        fall += float(np.sum(weighed.weights * (there - self.squares))) + weighed.fall - self.weighed.fall
        gram, slope = weighed.products([change])
        return fall, float(gram[0, 0]), float(slope[0])


class Weighed:
    """A parent's quadratic under weights of the blocks, solved for its own parameters and nuisances."""

    def __init__(self, of: Linearised, weights: np.ndarray) -> None:
        self.of, self.weights = of, weights
        parent, kept = of.parent, of.kept
        size, own = parent.space.size, parent.nuisance
        matrices = np.einsum("rb,rbij->rij", weights, parent.by_block[0])
        slopes = np.einsum("rb,rbi->ri", weights, of.gradient)
        self.inverse = np.linalg.inv(matrices[:, size:, size:] + own[..., None] * np.eye(own.shape[-1]))
        self.across = matrices[:, kept, size:]
        self.pull = slopes[:, size:] - own * parent.away
        prior = parent.space.precision[kept]
        solved = (self.inverse @ self.pull[..., None])[..., 0]
        self.force = (slopes[:, kept] - (self.across @ solved[..., None])[..., 0]).sum(axis=0)
        self.force -= prior * (parent.x - parent.space.mean)[kept]
        self.matrix = np.diag(prior) + (matrices[:, kept][:, :, kept]
                                        - self.across @ self.inverse @ self.across.transpose(0, 2, 1)).sum(axis=0)
        self.fall = float(np.sum(self.pull * solved) + self.force @ np.linalg.solve(self.matrix, self.force))
        """What moving the parent's own lowers -2 ln L by."""

    def products(self, changes: list[Change]) -> tuple[np.ndarray, np.ndarray]:
        """G (m, m) and b (m) of changes."""
        of, w, size = self.of, self.weights, self.of.parent.space.size
        slopes = np.stack([np.einsum("rb,rbk->rk", w, c.slopes) for c in changes], axis=2)
        errors = np.array([np.sum(w * of.by_errors(c)) for c in changes])
        if len(changes) == 1:
            gram = np.array([[np.sum(w * changes[0].squares)]])
        else:
            gram = np.zeros((len(changes), len(changes)))
            for r, weights in enumerate(w):
                rows = np.stack([c.scaled[r] * np.sqrt(weights)[:, None] for c in changes]).reshape(len(changes), -1)
                gram += rows @ rows.T
        own, mine = slopes[:, size:], slopes[:, of.kept]
        solved = self.inverse @ np.concatenate([own, self.pull[..., None]], axis=2)
        gram = gram - (own.transpose(0, 2, 1) @ solved[..., :-1]).sum(axis=0)
        slope = errors - (own.transpose(0, 2, 1) @ solved[..., -1:]).sum(axis=0)[:, 0]
        cross = (mine - self.across @ solved[..., :-1]).sum(axis=0)
        taken = np.linalg.solve(self.matrix, np.column_stack([cross, self.force]))
        return gram - cross.T @ taken[:, :-1], slope - cross.T @ taken[:, -1]
