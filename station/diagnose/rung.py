"""What is fitted on one rung of the search, and from where."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from station.diagnose.candidates import Candidate, one_too_many
from station.diagnose.disturbance import waves
from station.diagnose.remainder import remainder
from station.diagnose.screening import Screened, screen
from station.diagnose.selection import Selection
from station.diagnose.starts import Start, ahead_first, attempted, may_stick, rigid_starts
from station.diagnose.thresholds import LOG_PRIOR, WORTH_A_FIT
from station.estimation.cause import Key, Sizes
from station.estimation.fitted import Fit
from station.estimation.least_squares import FAR, inherited
from station.estimation.likelihood import Weighing
from station.estimation.parameters import parameters
from station.estimation.prediction import Predictor

QUICK_STEPS = 8
"""Steps of the fits by which further causes are tried, with derivatives of the parent where nothing sticks."""
LOAD_HOLDS = ("coulomb_friction", "base")
"""What a load may be held by while a play before it is open."""
PEAKS = 3
"""Peaks of the missing torque's spectrum over the angle that are tried as a ripple's waves per turn."""
RUNGS = 3
"""Causes in a set from which on nothing is added to it; a pair on top of the set before may hold one more."""


@dataclass(frozen=True)
class Job:
    """One fit of a rung."""

    label: str
    start: Start | tuple[Screened, ...]
    """Constants far from nominal, or further causes from where screening put them."""
    less: Key | None = None
    """The parent's cause in whose place they come."""
    gain: float = -np.inf
    """What screening expects the objective to fall by; nothing where it was not asked."""

    def fitted(self, predictor: Predictor, weighing: Weighing, parent: Fit) -> Fit | None:
        """A few steps, from far off by a weighing that is given; None where the hypothesis is lost."""
        if isinstance(self.start, Start):
            one = self.start
            return attempted(predictor, one.space, weighing, one.x, one.own, tolerance=0.5, first=FAR)
        return begun(predictor, parent, self.start, self.less)


def proposed(search: Selection, parent: Fit, pool: list[Candidate], far: list[Start]) -> list[Job]:
    """The most promising further causes on top of a parent that holds fewer than a set may, from where screening puts
    them and ``far`` from nominal, and those that could stand in the place of one that it has: what was added first need
    not be the best beside what came later."""
    predictor, effort, rung = search.predictor, search.effort, len(parent.key)
    wavy = [c for c in pool if c.effect and c.effect.waves and c.guesses]
    seen = waves(search.all_horizons, parent, PEAKS) if wavy else []
    screened, pairs, exchanges = screen(predictor, parent, [*pool, *(c.repeating(seen) for c in wavy)])
    search.screened = search.screened or screened
    jobs: list[Job] = []

    def add(start: tuple[Screened, ...], less: Key | None = None) -> None:
        label = " + ".join(one.candidate.hypothesis.label for one in start)
        case = next((key for one in start for key in sorted(parent.key) if one.candidate.hypothesis.holds(key)), None)
        jobs.append(Job(label, start, less or case, start[0].gain if less is None else -np.inf))

    def shows(*start: Screened, less: Key | None = None) -> bool:
        return not one_too_many(predictor.data.rig, parent.key - {less} | {one.candidate.key for one in start})

    grows = rung < RUNGS
    content = (effort.content and rung > 0 and remainder(predictor, parent).is_noise
               and not search.differs(parent))  # else what makes that needless pays for itself
    if grows and not content:
        rigid, search.stiffest = rigid_starts(predictor, parent, pool, search.stiffest)
        far = [*rigid, *far]
    jobs += [Job(f"{one.candidate.hypothesis.label}, far from nominal", one) for one in far]
    for less in sorted(exchanges):
        others = [one for one in exchanges[less] if one.gain > WORTH_A_FIT and shows(one, less=less)
                  and not any(one.candidate.hypothesis.holds(key) for key in parent.key - {less})]
        for other in others[: effort.exchanged]:
            add((other,), less)
    worth = -2.0 * LOG_PRIOR if content else WORTH_A_FIT
    begun_from: Counter[tuple[Key, bool]] = Counter()
    for cause in filter(shows, screened) if grows else []:
        of = cause.candidate.key, cause.candidate.by_torque
        if (cause.gain >= worth and (of in begun_from or of[1] or len(begun_from) < effort.tried)
                and begun_from[of] < cause.candidate.starts):
            begun_from[of] += 1
            add((cause,))
    for pair in [pair for pair in pairs if shows(*pair)][: effort.pairs] if grows and not content else []:
        if pair[0].gain > WORTH_A_FIT:
            add(pair)
    gap = next((one for one in screened if one.candidate.is_gap), None)
    if gap is not None and not parent.key and begun_from[gap.candidate.key, gap.candidate.by_torque]:
        for friction in held_loads(pool):
            add((gap, friction))
    return jobs


def held_loads(pool: Sequence[Candidate]) -> list[Screened]:
    """Friction at the load from each of its usual sizes, beside which a gap is begun as well.

    While a play is open friction alone says where the load goes; where none is it shows nothing, and by itself a gap
    behind which a light load rattles on is no better than none.
    """
    return [Screened(one, guess, 0.0, 1.0, 0.0) for one in pool if one.key == LOAD_HOLDS for guess in one.guesses]


def taking_in(one: Screened, less: Key, sizes: dict[str, float]) -> Sizes:
    """Sizes from which a cause begins in the place of another of such sizes, which are added where that is a special
    case of its law."""
    start, candidate = one.start[one.candidate.key], one.candidate
    case = candidate.effect.simpler[less[0]] if candidate.effect and candidate.hypothesis.holds(less) else {}
    return {candidate.key: start | {its: start[its] + sizes[name] for name, its in case.items()}}


def begun(predictor: Predictor, parent: Fit, start: Iterable[Screened], less: Key | None = None) -> Fit | None:
    """A parent's hypothesis with further causes, or with some in the place of one (``less``), a few steps from where
    screening put them; None where it is lost."""
    hypothesis, centres = parent.space.hypothesis, parent.space.values(parent.space.mean)
    if less is not None:
        hypothesis = hypothesis.without(less)
    first: Sizes = {}
    own = parent.own.copy()
    for one in start:
        hypothesis += one.candidate.hypothesis
        centres[one.candidate.key] = one.guess
        first |= one.start if less is None else taking_in(one, less, parent.space.values(parent.x).get(less, {}))
        own[:, 3] -= one.shared
    space = parameters(predictor.data, hypothesis, centres)
    x = space.carried(parent.space, parent.x, first)
    if may_stick(space) and len(hypothesis.causes) > 1:
        return ahead_first(predictor, space, parent.weighing, x, own, renewals=0, iterations=QUICK_STEPS,
                           tolerance=0.5)
    return attempted(predictor, space, parent.weighing, x, own, jacobian=inherited(parent, space), renewals=0,
                     first=FAR, iterations=QUICK_STEPS, tolerance=0.5)
