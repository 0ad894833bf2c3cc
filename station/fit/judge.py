"""What the data say about each constant at the fitted point, and what they leave open."""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg

from station.estimation.fitted import Fit
from station.estimation.identifiability import HALF, NORMAL
from station.estimation.parameters import Parameters
from station.fit.result import FitResult, FittedConstant, FlatDirection
from station.model.units import powers

FAR = 4.0
"""Stated standard deviations beyond which a constant is warned about."""
UNEXPLAINED = 2.0
"""Mean squared error, times the noise's, from which on the constants alone are said not to explain the runs."""
SHOWN = 0.1
"""Share of a flat direction's largest part from which on a constant is listed in it."""


def judge(space: Parameters, unseen: np.ndarray, seen: np.ndarray, found: Fit, held: tuple[str, ...], nominal: float,
          starts: int, agreeing: int) -> FitResult:
    """Intervals, correlations, flat directions and warnings.

    ``space``: of the n constants that are free and of effects' parameters that are uncertain; ``found`` moved the
    constants along ``seen`` (n, k) and not along ``unseen`` (n, n - k), where they are what the rig file says.
    ``nominal``: the nominal rig's ``Fit.misfit``.
    """
    n = len(space.paths)
    root = scipy.linalg.block_diag(space.root, np.diag([h.sigma for h in space.held]))
    whole = scipy.linalg.block_diag(seen, np.eye(len(space.held)))
    told = [np.r_[one.parts["constants"], one.parts["held"]] for one in (found.space, space)]   # no encoder's zero
    posterior = whole @ found.covariance[np.ix_(told[0], told[0])] @ whole.T
    posterior[:n, :n] += unseen @ unseen.T
    covariance, stated, moved = root @ posterior @ root.T, root @ root.T, root @ whole @ found.x[told[0]]
    deviation, names = np.sqrt(np.diag(covariance)), np.array(space.names())[told[1]].tolist()
    nominals = [*(space.rig.constants()[path] for path in space.paths), *(h.nominal for h in space.held)]
    angles = [False] * n + [h.angle for h in space.held]
    determined = np.clip(1.0 - deviation**2 / np.diag(stated), 0.0, 1.0)
    rows = []
    for name, nominally, angle, at, d, share in zip(names, nominals, angles, moved.tolist(), deviation.tolist(),
                                                    determined.tolist(), strict=True):
        one, value, other = (nominally + away if angle else nominally * math.exp(away)
                             for away in (at - NORMAL * d, at, at + NORMAL * d))
        rows.append(FittedConstant(name, nominally, value, min(one, other), max(one, other), share))
    loose = [row.path for row in rows if row.determined < HALF]
    far = [name for name, size in zip(names, np.abs(moved) / np.sqrt(np.diag(stated)), strict=True) if size > FAR]
    torque = powers(space.paths, 0)
    free = np.allclose(seen.T @ np.linalg.solve(space.root, torque), 0.0, atol=1e-9) and np.any(torque)
    warnings = [text for text, applies in (
        (f"one common factor of {', '.join(p for p, t in zip(space.paths, torque, strict=True) if t)} is invisible to "
         "command, encoder and accelerometer; hold one of them", free),
        (f"the data do not determine {', '.join(loose)}; what is said of them is mostly the rig file's own uncertainty",
         loose),
        (f"beyond {FAR:g} stated deviations: {', '.join(far)}", far),
        (f"what is left is {np.sqrt(found.misfit):.3g} times the noise: these constants alone do not explain the runs",
         found.misfit > UNEXPLAINED),
        (f"{starts - agreeing} of {starts} starts ended in another minimum", agreeing < starts)) if applies]
    flat = [_direction(space, unit, 1.0, always=True) for unit in unseen.T]
    values, vectors = np.linalg.eigh(seen.T @ posterior[:n, :n] @ seen)
    flat += [_direction(space, seen @ vector, float(value))
             for value, vector in zip(values[::-1], vectors.T[::-1], strict=True) if value > HALF]
    return FitResult(found.space.rig_at(found.x), tuple(rows), held, covariance / np.outer(deviation, deviation),
                     tuple(flat), tuple(warnings), found.misfit, nominal, starts, agreeing)


def _direction(space: Parameters, unit: np.ndarray, variance: float, always: bool = False) -> FlatDirection:
    """Of a direction in which the stated uncertainty is 1; ``always``: no data show it."""
    logs = space.root @ unit
    top = int(np.argmax(np.abs(logs)))
    terms = {space.paths[k]: float(logs[k] / logs[top]) for k in np.argsort(-np.abs(logs), kind="stable")
             if abs(logs[k]) > SHOWN * abs(logs[top])}
    return FlatDirection(terms, always, float(np.clip(1.0 - variance, 0.0, 1.0)))
