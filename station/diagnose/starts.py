"""Where a fit that sets a constant free begins, when nothing near nominal points to where it must go.

A beam of a fifth of its length shows other modes altogether: the objective has a valley at every one, and derivatives
at nominal lead into the nearest.  So the objective is worked out along each constant alone, over the whole width of its
prior, on stretches after the first command that are too short for the beam to fall out of step.  A joint that yields too
much hides one that does not yield at all, whatever the constant alone would do: it is begun stiff in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from station.diagnose.candidates import Candidate
from station.estimation.constants import BEGINNINGS, in_step, unknown
from station.estimation.dataset import beginning
from station.estimation.least_squares import LOST, Fit, fit
from station.estimation.likelihood import Weighing, cost
from station.estimation.parameters import WIDE, Parameters, parameters
from station.estimation.prediction import Predictor

JOINTS = ("drive.stiffness", "clamp.stiffness")
"""Constants of which a rig's own may be as good as infinite."""
RIGID = 3.0
"""Sigmas of a free constant's prior above nominal from which a fit of such a joint begins."""
AWAY = np.arange(-9, 10) / 3.0
"""Sigmas of that prior from nominal at which the objective is worked out: steps of a factor of 1.6."""
NEAR = 1
"""Steps of these within which derivatives at nominal find the way."""
SECONDS = BEGINNINGS[1]
"""Stretch after the first command for that: a period of a beam's slowest mode."""

Start = tuple[Candidate, float]
"""A constant, and sigmas of a free constant's prior from nominal at which it begins."""


def rigid_starts(pool: Sequence[Candidate]) -> list[Start]:
    """Joints as good as rigid."""
    return [(c, RIGID) for c in pool if c.constant in JOINTS]


def far_starts(predictor: Predictor, pool: Sequence[Candidate], most: int) -> list[Start]:
    """Of the ``most`` constants that, far from nominal, meet the runs' beginnings best."""
    part = predictor.on(beginning(predictor.data, SECONDS))
    weighing, at_nominal = unknown(part), len(AWAY) // 2

    def profile(candidate: Candidate) -> list[float]:
        space = parameters(part.data, candidate.hypothesis, {})
        return [_cost(part, space, _placed(space, candidate, sigmas, space.mean), weighing) for sigmas in AWAY]

    constants = [c for c in pool if c.constant is not None]
    found = []
    for candidate, costs in zip(constants, part.pool.map(profile, constants), strict=True):
        best = int(np.argmin(costs))
        start = (candidate, float(AWAY[best]))
        if abs(best - at_nominal) > NEAR and not _is_rigid(*start):
            found.append((costs[best], start))
    return [start for _, start in sorted(found, key=lambda row: row[0])[:most]]


def _is_rigid(candidate: Candidate, sigmas: float) -> bool:
    return candidate.constant in JOINTS and sigmas == RIGID


def _cost(part: Predictor, space: Parameters, x: np.ndarray, weighing: Weighing) -> float:
    with suppress(*LOST), np.errstate(over="ignore", invalid="ignore"):
        made = part.runs(space, x, part.data.own)
        squares = [np.sum(((part.measured(r) - y) * part.scale(r)) ** 2, axis=1) for r, y in enumerate(made)]
        return cost(np.array(squares), part.counts, weighing.independent)
    return np.inf


def _placed(space: Parameters, candidate: Candidate, sigmas: float, x: np.ndarray) -> np.ndarray:
    """``x`` (p) with all constants at nominal but the candidate's."""
    x = x.copy()
    logs = sigmas * WIDE * np.array([path == candidate.constant for path in space.paths])
    x[space.parts["constants"]] = np.linalg.solve(space.root, logs)
    return x


def begun_far(predictor: Predictor, parent: Fit, candidate: Candidate, sigmas: float, weighing: Weighing) -> Fit | None:
    """A parent's hypothesis with a constant free, begun so far from nominal; None where that does not simulate.

    The other constants begin at nominal: what the parent bent to make up for the one leads back to it.
    """
    space = parameters(predictor.data, parent.space.hypothesis + candidate.hypothesis,
                       parent.space.values(parent.space.mean))
    x = _placed(space, candidate, sigmas, space.carried(parent.space, parent.x))
    with suppress(*LOST):
        x, own = (x, parent.own) if _is_rigid(candidate, sigmas) else in_step(predictor, space, x, parallel=False)
        return fit(predictor, space, weighing, x, own, parallel=False, tolerance=0.5).light
    return None
