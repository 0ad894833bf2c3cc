"""How well the runs determine each fitted value: determined, at a bound, traded off, not excited.

The posterior precision is H + P^-1, H what the data say and P the prior covariance, so that the posterior covariance
C = (H + P^-1)^-1 is the sum of what the noise leaves, C H C, and of what the prior alone holds, C P^-1 C.  For value i

    share_i = (C P^-1 C)_ii / C_ii     of its variance is the prior's: doubling the prior's sigma adds that share of
                                       it (to first order) to the value's own
    alone_i = (P^-1)_ii / (C^-1)_ii    the same with all other values known

A value whose share is at most half is determined.  Where the prior holds it even with all others known (alone), or
where it moves with no other (correlations below MOVES), these runs do not excite it.  Else the runs see it, but only
together with others: it is traded off, and so is a value that follows another (correlation beyond FOLLOWS), however
well both are known.  So all constants that carry the unit of torque are traded off with each other: their ratios are
determined, their common factor is the rig file's.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np
import scipy.linalg

from station.estimation.parameters import FARTHEST, Held, Parameters
from station.model.effects import Effect
from station.model.units import UnknownUnitError, dimension, powers

State = Literal["determined", "at_bound", "traded_off", "not_excited"]
NORMAL = 1.96
"""Standard deviations that bound 95 % of a normal distribution."""
HALF = 0.5
"""Share of the variance from which on the prior holds a value rather than the runs."""
MOVES, FOLLOWS = 0.5, 0.95
"""Correlations of two values from which on one moves with the other, and from which on it follows it."""


def states(covariance: np.ndarray, prior: np.ndarray, bounded: Collection[int] = ()) -> list[State]:
    """States of n values from their posterior and prior covariances (n, n), in the same coordinates.

    ``bounded``: indices of the values that stand at a bound.
    """
    inverse = np.linalg.inv(prior)
    variance = np.diag(covariance)
    share = np.diag(covariance @ inverse @ covariance) / variance
    alone = np.diag(inverse) / np.diag(np.linalg.inv(covariance))
    correlation = np.abs(covariance / np.sqrt(np.outer(variance, variance))) - np.eye(len(variance))

    def state(i: int, others: np.ndarray) -> State:
        if i in bounded:
            return "at_bound"
        if share[i] > HALF and (alone[i] > HALF or others.max() < MOVES):
            return "not_excited"
        return "traded_off" if share[i] > HALF or others.max() > FOLLOWS else "determined"
    return [state(i, others) for i, others in enumerate(correlation)]


def parameter_states(space: Parameters, covariance: np.ndarray, x: np.ndarray) -> list[State]:
    """States of a hypothesis' parameters in the order of x, constants as logarithms.

    ``covariance`` (p, p) is the posterior's in the coordinates of x, as ``Fit.covariance`` gives it.
    """
    n = len(space.paths)
    to_logs = scipy.linalg.block_diag(space.root, np.eye(space.size - n))
    prior = to_logs @ np.diag(1.0 / space.precision) @ to_logs.T
    bounded = [i for i, log in enumerate(space.logs(x)) if abs(log) >= FARTHEST]
    for k, coordinate in enumerate(space.coordinates, space.parts["effects"].start):
        info = coordinate.info
        if not info.periodic and coordinate.to_value(x[k]) in (info.low, coordinate.high):
            bounded.append(k)
    return states(to_logs @ covariance @ to_logs.T, prior, bounded)


def unseen(space: Parameters) -> np.ndarray:
    """(n, k) orthonormal directions of the constants' part of x that no data show, all other constants held.

    They are those of the units of torque and length, which no reading carries (``diagnose.equivalences``), each unless
    an effect of the rig fixes it.
    """
    logs, together = _units(space, _open(space, ()))
    return np.linalg.qr(np.linalg.solve(space.root, logs @ together))[0]


def unseen_with_effects(space: Parameters, x: np.ndarray) -> np.ndarray:
    """(p, k) the same of all of x, at x: the sizes of effects move with the constants."""
    effects = [coordinate.info.unit for coordinate in space.coordinates]
    if space.root.shape[1] < len(space.paths) or not all(map(_is_known, effects)):
        return np.zeros((space.size, 0))
    held = [space.rig.effects[one.effect].parameters()[one.name].unit for one in space.held]
    units = _open(space, space.held)
    logs, together = _units(space, units)
    moved = np.zeros((space.size, len(together)))
    moved[space.parts["constants"]] = np.linalg.solve(space.root, logs)
    for k, unit in enumerate(units):
        moved[space.parts["effects"], k] = [
            dimension(name)[unit] * (1.0 if coordinate.log else at)
            for name, coordinate, at in zip(effects, space.coordinates, x[space.parts["effects"]], strict=True)]
        moved[space.parts["held"], k] = [dimension(name)[unit] / one.sigma
                                         for name, one in zip(held, space.held, strict=True)]
    return np.linalg.qr(moved @ together)[0]


def _open(space: Parameters, held: Sequence[Held]) -> list[int]:
    """The units of torque and length that some constant bears and no effect of the rig fixes, but for what is ``held``
    of it within an uncertainty."""
    moving = [{one.name for one in held if one.effect == k} for k in range(len(space.rig.effects))]
    return [unit for unit in (0, 1) if np.any(powers(list(space.rig.constants()), unit))
            and not any(_carries(effect, unit, names) for effect, names in zip(space.rig.effects, moving, strict=True))]


def _units(space: Parameters, units: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """(n, u) powers of units in the logarithms of the constants that move, and (u, k) those combinations of the units
    that leave the other constants where they are."""
    constants = list(space.rig.constants())
    basis = np.array([powers(constants, unit) for unit in units]).reshape(-1, len(constants))
    fixed = [k for k, path in enumerate(constants) if path not in space.paths]
    return basis[:, [constants.index(path) for path in space.paths]].T, scipy.linalg.null_space(basis[:, fixed].T)


def _carries(effect: Effect, unit: int, moving: Collection[str]) -> bool:
    """Whether an effect has a size with this unit in it, or one that is not known, beside those that move."""
    return any(value != 0.0 and (not _is_known(of := effect.parameters()[name].unit) or dimension(of)[unit] != 0)
               for name, value in effect.values().items() if name not in moving)


def _is_known(unit: str) -> bool:
    try:
        return bool(dimension(unit))
    except UnknownUnitError:
        return False
