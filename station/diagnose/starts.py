"""Where a fit that sets a constant free begins, when nothing near nominal points to where it must go.

A beam of a fifth of its length shows other modes altogether: the objective has a valley at every one, and derivatives
at nominal lead into the nearest.  So the objective is worked out along each constant alone, over the whole width of
its prior, on stretches after the first command that are too short for the beam to fall out of step.  Where others must
move with it a constant alone shows nothing, and from whole runs in a side valley nothing points to it either; there
counts what the quadratic of such stretches promises of setting it free.  A joint that yields too much hides one that
does not yield at all, whatever the constant alone would do: it is held stiff until the others have followed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import methodcaller
from typing import Any

import numpy as np

from station.diagnose.candidates import Candidate
from station.diagnose.screening import freed
from station.diagnose.thresholds import LOG_PRIOR, WORTH_A_FIT
from station.estimation.constants import FIRST_SECONDS, in_step, unknown
from station.estimation.dataset import first_seconds
from station.estimation.fitted import Fit
from station.estimation.least_squares import DIVERGED, fit, point
from station.estimation.likelihood import Weighing, cost, rho
from station.estimation.observer import Observer, observers
from station.estimation.parameters import WIDE, Parameters, parameters
from station.estimation.prediction import Predictor
from station.model.effects import Stage

JOINTS = ("drive.stiffness", "clamp.stiffness")
"""Constants of which a rig's own may be as good as infinite."""
RIGID = (1.5, 3.0, 4.5)
"""Sigmas of a free constant's prior above nominal at which such a joint is held: 9, 90 and 850 times as stiff."""
AWAY = np.arange(-6, 7) / 2.0
"""Sigmas of that prior from nominal at which the objective is worked out: steps of a factor of 2.1."""
SECONDS = FIRST_SECONDS[1]
"""Stretch after the first command for that: a period of a beam's slowest mode."""
AROUND = 24
"""Angles at which an encoder's zero is tried, evenly spaced over a turn: a sine is nearly straight between two."""
FARTHEST = 0.5
"""Longest horizon ahead by which a gap is sought, s: some ten blows of light masses on a soft shaft."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit that sets one constant more free begins."""

    candidate: Candidate
    space: Parameters
    x: np.ndarray
    own: np.ndarray
    """(runs, 4) what each run has of its own (``Dataset.own``)."""


def attempted(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray,
              **how: Any) -> Fit | None:
    """A fit from ``x`` (p) and ``own`` (runs, 4), without derivatives; None where it goes where nothing simulates."""
    with suppress(*DIVERGED):
        return fit(predictor, space, weighing, x, own, **how).light
    return None


def has_gap(space: Parameters) -> bool:
    """Whether a hypothesis holds a gap, which closes with a blow."""
    return any(cls.stage is Stage.GAP for cls, _ in space.hypothesis.effects)


def seeks_zeros(space: Parameters) -> bool:
    """Whether a cause of a hypothesis goes by the absolute angle, and some encoder's zero is not known."""
    return space.known_zeros > 0 and space.zeros > 0


def may_stick(space: Parameters) -> bool:
    """Whether a hypothesis holds a friction that holds a rig at rest."""
    return any(cls.stage is Stage.FRICTION for cls, _ in space.hypothesis.effects)


def ahead_first(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray,
                **how: Any) -> Fit | None:
    """The same, begun where the shortest horizon alone leads, where there is another.

    What friction holds answers no torque until it lets go: a whole run rests where another size of what pulls beside
    it would have it rest, and its objective has a step at every such place.  A few samples ahead of what was read the
    rig moves where it did.
    """
    if len(predictor.observers) > 1:
        near = _led_by(predictor.observers[:1], predictor, space, weighing, x, own, **how)
        x, own = (near.x, near.own) if near is not None else (x, own)
    return attempted(predictor, space, weighing, x, own, **how)


def _led_by(watched: tuple[Observer, ...], predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray,
            own: np.ndarray, **how: Any) -> Fit | None:
    """The same by some horizons alone, of whose errors nothing is known yet; runs differ by as much."""
    one = replace(predictor, observers=watched)
    return attempted(one, space, replace(unknown(one), differ=weighing.differ), x, own, **how)


def arrived(predictor: Predictor, space: Parameters, weighing: Weighing, x: np.ndarray, own: np.ndarray,
            **how: Any) -> Fit | None:
    """The same or, if that is better, one whose constants begin nominal where they are no causes, and from the better
    one whose encoders' zeros are ``turned``.

    What was bent to make up for a cause that was not there yet may lead to another size of it.  A gap is led there by
    horizons that double from the shortest to FARTHEST: after a few blows of one that is a little wrong a run is out of
    step, so that the objective of long horizons has a valley at every size and the shortest says little.  The shorter
    the horizon the smoother it is (Ribeiro, Tiels, Umenberger, Schon and Aguirre, Automatica 121, 2020): each ends
    where the next is smooth.
    """
    ends = [attempted(predictor, space, weighing, x, own, **how)]
    data, horizon = predictor.data, predictor.observers[0].horizon
    x, own = _else_nominal(space, x), data.own
    while horizon <= FARTHEST and has_gap(space):
        near = _led_by(observers(data.rig, data.noise[0], (horizon,)), predictor, space, weighing, x, own, **how)
        if near is None:
            break
        x, own, horizon = near.x, near.own, 2.0 * horizon
    ends.append(attempted(predictor, space, weighing, x, own, **how))
    best = min(filter(None, ends), key=lambda one: one.objective, default=None)
    if best is None or not seeks_zeros(space) or (x := turned(predictor, best)) is None:
        return best
    again = attempted(predictor, space, weighing, x, data.own, **how)
    return min(best, again or best, key=lambda one: one.objective)


def turned(predictor: Predictor, found: Fit) -> np.ndarray | None:
    """(p) the parameters of a fit, constants nominal that are no causes, and each encoder's zero, as far as it is
    unknown, at that of AROUND angles at which its own runs are met best with nothing else of their own; None where all
    stay.

    Of a force that goes by a sine a run shows little more than where it stands, and that it does in two places, or a
    constant of its own stands for it.
    """
    space, groups, costs = found.space, np.array(predictor.data.zero_groups), []
    begun = _else_nominal(space, found.x)
    zeros, turns = space.parts["zeros"], 2.0 * np.pi * np.arange(AROUND) / AROUND
    for turn in turns:
        x = begun.copy()
        x[zeros] += turn
        with np.errstate(over="ignore", invalid="ignore"):
            made = point(predictor, space, found.weighing, x, predictor.data.own).squares
            costs.append(np.sum(found.weighing.independent * rho(made / found.counts), axis=1))
    by_run = np.nan_to_num(costs, nan=np.inf)
    best = [turns[np.argmin(by_run[:, groups == group].sum(axis=1))] for group in space.free_zeros]
    begun[zeros] = np.remainder(begun[zeros] + best + np.pi, 2.0 * np.pi) - np.pi
    return begun if any(best) else None


def _else_nominal(space: Parameters, x: np.ndarray) -> np.ndarray:
    """``x`` (p) with all constants nominal that are no causes."""
    return space.placed(x, np.where(np.isin(space.paths, space.hypothesis.constants), space.logs(x), 0.0))


@dataclass(frozen=True, eq=False)
class _Held:
    """A hypothesis' other parameters, fitted while a constant is held so many sigmas of ``WIDE`` from nominal."""

    candidate: Candidate
    sigmas: float
    predictor: Predictor
    """Of the rig with that constant."""
    space: Parameters
    """Without it."""
    x: np.ndarray
    own: np.ndarray
    objective: float = math.inf

    def followed(self, seconds: Sequence[float]) -> dict[str, Any]:
        """What changes where it is fitted to longer beginnings of the runs, s."""
        with suppress(*DIVERGED):
            found = in_step(self.predictor, self.space, self.x, self.own, seconds)
            return {"x": found.x, "own": found.own, "objective": found.objective}
        return {"objective": math.inf}


def rigid_starts(predictor: Predictor, parent: Fit, pool: Sequence[Candidate],
                 before: Mapping[str, float]) -> tuple[list[Start], dict[str, float]]:
    """A parent's hypothesis with a joint as good as rigid, once for each joint with which longer and longer beginnings
    of the runs are met better than by the parent where it stands; and, by joint, with how many sigmas they are met
    best: how stiff it is beside other causes need not be looked for again (``before``).

    The joint is held while the others are fitted ``in_step``, from nominal where they are no causes: what the parent
    bent to make up for it leads back to a joint that yields, and so does one that is free before the others follow.
    Judged is the longest horizon alone, as in ``_profiles``.
    """
    slow, sizes = predictor.at_longest, parent.space.values(parent.space.mean)

    def held(candidate: Candidate, sigmas: float) -> _Held:
        path, nominal = candidate.constant, slow.data.rig.constants()
        rig = slow.data.rig.with_constants({path: nominal[path] * math.exp(sigmas * WIDE)})
        stiff = slow.on(replace(slow.data, rig=rig))
        space = parameters(stiff.data, parent.space.hypothesis, sizes, fixed=(path,))
        x = _else_nominal(space, space.carried(parent.space, parent.x))
        return _Held(candidate, sigmas, stiff, space, x, slow.data.own)

    tried = [held(c, sigmas) for c in pool if c.constant in JOINTS
             for sigmas in ((before[c.constant],) if c.constant in before else RIGID)]
    stiffest: dict[str, float] = {}
    for seconds in (FIRST_SECONDS[:2], FIRST_SECONDS[2:]):
        part = slow.on(first_seconds(slow.data, seconds[-1]))
        least = point(part, parent.space, unknown(part), parent.x, parent.own).objective
        ends = predictor.pool.map(methodcaller("followed", seconds), tried)
        tried = [replace(one, **end) for one, end in zip(tried, ends, strict=True)]
        best = {one.candidate: one for one in sorted(tried, key=lambda one: -one.objective)}
        stiffest = stiffest or {one.candidate.constant: one.sigmas for one in best.values()}
        tried = [one for one in best.values() if one.objective < least]

    def start(one: _Held) -> Start:
        space = parameters(predictor.data, parent.space.hypothesis + one.candidate.hypothesis, sizes)
        x = _placed(space, one.candidate, one.sigmas, space.carried(one.space, one.x))
        return Start(one.candidate, space, x, one.own)
    return [start(one) for one in tried], stiffest


def far_starts(predictor: Predictor, pool: Sequence[Candidate], most: int, alone: Fit) -> list[Start]:
    """The rig alone with one constant free, where that meets the runs' beginnings better than the rig alone can
    (``alone``: fitted ``in_step``).

    Tried are ``most`` of those that far from nominal meet them best before anything is fitted, and half as many of
    those whose freedom the quadratic about ``alone`` promises most of, if that can pay for its prior odds.
    """
    constants, least = [c for c in pool if c.constant in alone.space.paths], alone.objective
    rows = sorted(_profiles(predictor, constants), key=lambda row: row[0])
    tried = [(candidate, sigmas) for _, sigmas, candidate in rows if sigmas != 0.0][:most]
    quadratic = alone.normal(alone.weighing)
    promised = sorted((freed(predictor, alone, c, *quadratic) for c in constants), key=lambda one: -one.gain)
    tried += [(one.candidate, 0.0) for one in promised[: most // 2]
              if one.gain > -2.0 * LOG_PRIOR and one.candidate not in [candidate for candidate, _ in tried]]

    def begun(row: tuple[Candidate, float]) -> Start | None:
        candidate, sigmas = row
        space = parameters(predictor.data, candidate.hypothesis, {})
        with suppress(*DIVERGED):
            found = in_step(predictor, space, _placed(space, candidate, sigmas, space.mean))
            worth = found.objective < least - WORTH_A_FIT
            return Start(candidate, space, found.x, found.own) if worth else None
        return None

    return [start for start in predictor.pool.map(begun, tried) if start is not None]


def _profiles(predictor: Predictor, constants: Sequence[Candidate]) -> list[tuple[float, float, Candidate]]:
    """Of each constant the least objective along it, how many sigmas from nominal that lies, and the constant.

    On one mesh, a place to begin needs none that is finer; and by the longest horizon alone: an observer that forgets
    corrects what a rig far from the true one does as well as what another one does.
    """
    data = first_seconds(predictor.data, SECONDS)
    part = predictor.at_longest.on(replace(data, rig=data.rig.with_fixed_mesh()))
    weighing = unknown(part)

    def profile(candidate: Candidate) -> tuple[float, float, Candidate]:
        space = parameters(part.data, candidate.hypothesis, {})
        return min(((_cost(part, space, _placed(space, candidate, sigmas, space.mean), weighing), sigmas, candidate)
                    for sigmas in AWAY.tolist()), key=lambda row: row[0])
    return list(part.pool.map(profile, constants))


def _cost(part: Predictor, space: Parameters, x: np.ndarray, weighing: Weighing) -> float:
    with suppress(*DIVERGED), np.errstate(over="ignore", invalid="ignore"):
        return cost(point(part, space, weighing, x, part.data.own).squares, part.counts, weighing.independent)
    return np.inf


def _placed(space: Parameters, candidate: Candidate, sigmas: float, x: np.ndarray) -> np.ndarray:
    """``x`` (p) with the candidate's constant so far from nominal."""
    logs = space.logs(x)
    logs[space.paths.index(candidate.constant)] = sigmas * WIDE
    return space.placed(x, logs)
