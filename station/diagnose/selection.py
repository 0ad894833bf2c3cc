"""Selecting causes: fit the rig alone, then one cause more at a time, and judge every set by one score.

Each rung screens all causes on top of the best set so far (``screening``), fits those expected to gain most, and looks
back: a set must hold against every set with one cause less.  What the blocks of errors count for (``Weighing``) is read
off the best set and is the same for all sets that are compared; with it the score is a pure function of a fit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from station.diagnose.candidates import Candidate, candidates, one_too_many
from station.diagnose.disturbance import waves
from station.diagnose.remainder import ahead_is_noise, misses_more_ahead, remainder
from station.diagnose.screening import Screened, screen
from station.diagnose.starts import (
    Start,
    ahead_first,
    arrived,
    attempted,
    far_starts,
    has_gap,
    may_stick,
    rigid_starts,
    seeks_zeros,
)
from station.diagnose.thresholds import CLOSE, LOG_PRIOR, LOG_PRIOR_PARAMETER, WORTH_A_FIT
from station.estimation.cause import Causes, Key, Sizes, is_constant
from station.estimation.constants import base_fit, in_step, settled, told_again
from station.estimation.fitted import MOST_GAINED, Fit, weighing_of
from station.estimation.least_squares import FAR, fit, inherited
from station.estimation.likelihood import Weighing
from station.estimation.parameters import CLOCK_SIGMA, Hypothesis, Parameters, parameters
from station.estimation.prediction import COARSE, FINE, SEARCH, Accuracy, Predictor
from station.model.effects import Stage, effect_class

QUICK_STEPS = 8
"""Steps of the fits by which further causes are tried, with derivatives of the parent where nothing sticks."""
LOAD_HOLDS = ("coulomb_friction", "base")
"""What a load may be held by while a play before it is open."""
PEAKS = 3
"""Peaks of the missing torque's spectrum over the angle that are tried as a ripple's waves per turn."""
RUNGS = 3
"""Causes in a set from which on nothing is added to it; a pair on top of the set before may hold one more."""
THOROUGH: dict[str, Any] = {"iterations": 25, "renewals": 4, "tolerance": 0.2}


@dataclass(frozen=True)
class Effort:
    """How far a search goes."""

    tried: int
    """Causes that are fitted on each rung, with derivatives of the parent."""
    finished: int
    """Of these, how many are fitted to the end; and constants that are begun far from nominal."""
    pairs: int
    """Pairs of causes that are fitted on each rung."""
    exchanged: int
    """Causes that are fitted in the place of each one that a set has, beside its others."""
    content: bool
    """Whether to a set that leaves nothing but noise only what can pay for its prior odds is added."""
    accuracies: tuple[Accuracy, Accuracy]
    """Of simulations in the search, and of those from which values are stated."""


EFFORTS = {"quick": Effort(tried=6, finished=2, pairs=2, exchanged=1, content=True, accuracies=(COARSE, SEARCH)),
           "full": Effort(tried=12, finished=4, pairs=3, exchanged=3, content=False, accuracies=(SEARCH, FINE))}


def log_prior(cause: Key) -> float:
    """Log prior odds of one further cause, with each further parameter of its law."""
    further = 0 if is_constant(cause[0]) else len(effect_class(cause[0]).parameters()) - 1
    return LOG_PRIOR + LOG_PRIOR_PARAMETER * further


@dataclass
class Selection:
    """All fits by their set of causes, and what errors count for."""

    all_horizons: Predictor
    effort: Effort
    weighing: Weighing
    """In fits."""
    fits: dict[Causes, Fit] = field(default_factory=dict)
    screened: list[Screened] = field(default_factory=list)
    """Of the first rung."""
    stiffest: dict[str, float] = field(default_factory=dict)
    """By joint, how many sigmas above nominal it was held best where it hardly yields (``rigid_starts``)."""
    complete: bool = False
    """Whether what the weighing was read off leaves nothing but noise."""
    weighed_by: Causes = frozenset()
    """The set that it was read off."""
    judging: Weighing | None = None
    """What errors count for where sets are compared, if it is not the same (``judge``)."""
    found_by: Weighing | None = None
    """What errors count for where sets are compared and parameters found, if these are not the same (``judge``)."""
    arrived: set[Causes] = field(default_factory=set)
    """Sets that were fitted from nominal constants, too (``starts.arrived``)."""
    looked_back: Fit | None = None
    """The fit that was last looked back upon."""
    _weighed: WeakKeyDictionary[Fit, tuple[Weighing, float, float]] = field(default_factory=WeakKeyDictionary)
    """As sets are compared: each fit's own weighing, its evidence, and the price of its own."""

    @property
    def predictor(self) -> Predictor:
        """At the horizons that count: output errors alone where nothing but noise is left, for an observer feeds the
        sensors' noise back into what it predicts, by gains that are each hypothesis's own."""
        return self.all_horizons.at_longest if self.complete else self.all_horizons

    @property
    def compared(self) -> Weighing:
        """What errors count for where sets are compared."""
        return self.judging or self.weighing

    def evidence(self, found: Fit) -> float:
        """Log evidence of a set of causes, up to a constant.

        How much runs differ is each set's own: what is most likely of all data, at the price of saying so.  Where
        something is left that no hypothesis holds, that they differ is a part of it.  Where nothing is, it is one more
        thing that acts, no likelier beforehand than any one cause, and a set may do without.
        """
        _, whole, price = self._own(found)
        return price + whole

    def own_weighing(self, found: Fit) -> Weighing:
        """The weighing with what runs differ by by this set of causes."""
        if self.judging is None:
            return self._own(found)[0]
        return replace(self.weighing, differ=found.most_likely_differ(self.weighing))

    def differs(self, found: Fit) -> bool:
        """Whether a set of causes pays for runs to differ."""
        return self._own(found)[2] != 0.0

    def _own(self, found: Fit) -> tuple[Weighing, float, float]:
        if found not in self._weighed:
            ways = [both := self._differing(found, (True, True))]
            if self.complete:
                ways.insert(0, alike := self._differing(found, (False, False)))
                if both[1] - alike[1] > -LOG_PRIOR:     # else neither can pay for itself
                    ways += [self._differing(found, may) for may in ((True, False), (False, True))]
            self._weighed[found] = max(ways, key=lambda one: one[1] + one[2])
        return self._weighed[found]

    def _differing(self, found: Fit, may: tuple[bool, bool]) -> tuple[Weighing, float, float]:
        """The same where runs may differ in their share of the command, and in a constant."""
        weighing = self.found_by or self.compared
        may = (may[0] and weighing.may[0], may[1] and weighing.may[1])
        weighing = replace(weighing, may=may)
        own = replace(weighing, differ=found.most_likely_differ(weighing))
        price = found.log_narrowing(own) + (LOG_PRIOR if self.complete else 0.0) if any(may) else np.zeros(2)
        own = replace(self.compared, differ=own.differ)
        return own, found.log_evidence(own, self.found_by), float(price @ may)

    def score(self, found: Fit) -> float:
        """Log posterior of a set of causes, up to a constant."""
        hypothesis = found.space.hypothesis
        score = self.evidence(found) + sum(map(log_prior, hypothesis.causes)) + self.clock_score(hypothesis)
        return score if np.isfinite(score) else -np.inf

    def scores(self, found: Fit, drawn: np.ndarray) -> np.ndarray:
        """(k) the same of resampled stretches, ``drawn`` (k, s)."""
        own, whole, _ = self._own(found)
        scores = self.score(found) + (found.log_evidences(own, np.array(own.differ), drawn, self.found_by) - whole)
        return np.where(np.isfinite(scores), scores, -np.inf)

    def clock_score(self, hypothesis: Hypothesis) -> float:
        """Log density of the clocks' own comparison, over the highest that it has where the board's clock is right; one
        that is off may be so by any ratio of its prior."""
        data = self.all_horizons.data
        if data.clock is None:
            return 0.0
        ratio, sigma = data.clock
        off = any(cls.stage is Stage.CLOCK for cls, _ in hypothesis.effects)
        width = math.hypot(sigma, CLOCK_SIGMA) if off else sigma
        return -0.5 * (math.log(ratio) / width) ** 2 - math.log(width / sigma)

    def best(self) -> Fit:
        """The set of causes with the highest posterior."""
        return max(self.fits.values(), key=self.score)

    def close(self, most: int) -> list[Fit]:
        """The likeliest sets, not more than ``most``, within CLOSE of the best."""
        ranked = sorted(self.fits.values(), key=lambda f: -self.score(f))
        return [f for f in ranked if self.score(f) > self.score(ranked[0]) - CLOSE][:most]

    def is_news(self, found: Fit, since: Fit) -> bool:
        """Whether a fit holds more causes than an earlier one, or is better by what these runs can tell."""
        return len(found.key) > len(since.key) or 2.0 * (self.score(found) - self.score(since)) >= WORTH_A_FIT

    def keep(self, found: Fit, begun_at: Fit | None = None) -> None:
        """Remember a fit; of the same causes the better one, but never ``begun_at``, from where this one was fitted on:
        what a step was expected to gain there has been tried since."""
        old = self.fits.get(found.key)
        if old is None or old is begun_at or self.score(found) > self.score(old):
            self.fits[found.key] = found.light

    def weigh(self, found: Fit) -> Fit:
        """Take what a fit leaves for what models of this rig leave; the fit, with the blocks that count by that."""
        complete = remainder(self.predictor, found).is_noise
        if complete != self.complete:
            found = self._counting(complete, found)
        self.weighing = weighing_of(self.predictor, found)
        self.weighed_by = found.key
        self._weighed.clear()
        return found

    def _counting(self, complete: bool, found: Fit) -> Fit:
        """Have all fits tell of the blocks that count from here on; and one fit more, which is returned."""
        self.complete = complete
        seen = partial(Fit.only, blocks=self.all_horizons.longest) if complete else partial(told_again, self.predictor)
        self.fits = {key: seen(one) for key, one in self.fits.items()}
        self.looked_back = self.looked_back and seen(self.looked_back)
        return seen(found)

    def judge(self) -> None:
        """From here on compare sets by what they predict from what was read just before, where that shows more than
        noise.

        Whole runs go by the commands with which a loop made up for what no hypothesis holds, and that is met best by
        what holds the rig in its place: where a loop rests, by friction that is not there.  The direct method errs by
        what its model of the disturbances lacks (Forssell and Ljung, Automatica 35, 1999), and a simulation has none.
        Where it shows no more than noise, by the rig alone and by the best set, it says nothing but what each
        hypothesis's own observer makes of that, and whole runs compare alone: those sets that leave no more there.
        """
        if not self.complete:
            best, alone = self.fits[self.weighed_by], self.fits[frozenset()]
            noise = ahead_is_noise(self.predictor, best, alone)
            if noise:
                self.fits = {key: one for key, one in self.fits.items()
                             if not misses_more_ahead(self.predictor, one, best)}
            self.judging = weighing_of(self.predictor, best, self.predictor.longest if noise else self.predictor.ahead)
            self.found_by = self.weighing if noise else None
            self._weighed.clear()

    def known(self, found: Fit) -> Fit:
        """A fit as far as that tells of it by which sets are compared: errors that do not say which causes there are do
        not say how well their sizes are known, either.

        The longer a run is simulated, the finer it tells where in a wave or a gap it is, and the less a derivative
        there holds for what is a little further on.
        """
        if self.judging is None or self.found_by is not None:
            return found
        counts = self.judging.independent > 0.0
        return replace(found, weighing=replace(found.weighing, independent=found.weighing.independent * counts))

    @property
    def reading(self) -> tuple[Causes, bool]:
        """The set that the weighing was read off, and whether that left nothing but noise."""
        return self.weighed_by, self.complete

    @property
    def wanted(self) -> tuple[Causes, bool]:
        """What it would be read off now: the best set."""
        best = self.best()
        return best.key, remainder(self.predictor, best).is_noise


def select(predictor: Predictor, effort: Effort, progress: Callable[[str, float], None]) -> Selection:
    """The whole search."""
    progress("fitting the nominal rig's constants", 0.05)
    alone = parameters(predictor.data, Hypothesis(), {})
    beginnings = in_step(predictor, alone, alone.mean)
    parent = base_fit(predictor, beginnings)
    search = Selection(predictor, effort, parent.weighing)
    search.keep(search.weigh(parent))
    parent = _with_derivatives(search, search.fits[parent.key])
    pool = candidates(predictor.data.rig, predictor.data.speed)
    far = far_starts(predictor, pool, effort.finished, beginnings)
    climbed: set[Causes] = set()
    while parent.key not in climbed:
        climbed.add(parent.key)
        rung = len(parent.key)
        if rung > 0 and predictor.data.clock is None:
            # Beside another cause a clock is but one more way to move the constants, which no data tell from theirs.
            pool = [c for c in pool if c.effect is None or c.effect.stage is not Stage.CLOCK]
        further = [c for c in pool if c.key not in parent.key and not parent.space.hypothesis.holds(c.key)]
        _climb(search, parent, further, [] if rung else far, progress)
        best = search.best()
        if not search.is_news(best, search.fits[parent.key]):
            break
        _look_back(search, _settle(search, best))
        if search.wanted != search.reading:
            _settle(search, search.best())
        parent = _with_derivatives(search, search.best())
    progress("fitting rivals as far as the best", 0.82)
    if not all(search.weighing.may):
        _free(search)
    _finish(search)
    search.judge()
    return search


def _settle(search: Selection, best: Fit) -> Fit:
    """The best set, settled under the weighing that it gives, and its rivals fitted again: where the weighing changed
    theirs are not comparable."""
    rivals = search.close(1 + search.effort.finished)[1:]
    best = search.weigh(settled(search.predictor, best))
    search.keep(best)
    _refit(search, [search.fits[rival.key] for rival in rivals], False)
    return best


def _with_derivatives(search: Selection, found: Fit) -> Fit:
    """The same set, fitted to the end under the weighing in force, with derivatives to hand on.

    They are worked out where it ended: of what screening takes out by them little is left, and that must be right.
    """
    space, x = centred(search.predictor, found, search.complete)
    again = fit(search.predictor, space, search.own_weighing(found), x, found.own, to_the_end=True)
    search.keep(again, found)
    return again


def _climb(search: Selection, parent: Fit, pool: list[Candidate], far: list[Start],
           progress: Callable[[str, float], None]) -> None:
    """Fit the most promising further causes on top of a parent that holds fewer than a set may, from where screening
    puts them and ``far`` from nominal, and those that could stand in the place of one that it has: what was added first
    need not be the best beside what came later."""
    predictor, weighing, effort, rung = search.predictor, search.weighing, search.effort, len(parent.key)
    begin, end = (min(0.1 + 0.7 * done / (RUNGS + 1), 0.8) for done in (rung, rung + 1))

    def told(text: str, share: float) -> None:
        progress(text, begin + (end - begin) * share)

    wavy = [c for c in pool if c.effect and c.effect.waves and c.guesses]
    seen = waves(search.all_horizons, parent, PEAKS) if wavy else []
    screened, pairs, exchanges = screen(predictor, parent, [*pool, *(c.repeating(seen) for c in wavy)])
    grows = rung < RUNGS
    content = (effort.content and rung > 0 and remainder(predictor, parent).is_noise
               and not search.differs(parent))  # else what makes that needless pays for itself
    worth = -2.0 * LOG_PRIOR if content else WORTH_A_FIT
    if not search.screened:
        search.screened = screened
    jobs: list[tuple[str, float, Start | tuple[tuple[Screened, ...], Key | None]]] = []

    def add(start: tuple[Screened, ...], less: Key | None = None) -> None:
        label = " + ".join(one.candidate.hypothesis.label for one in start)
        case = next((key for one in start for key in sorted(parent.key) if one.candidate.hypothesis.holds(key)), None)
        jobs.append((label, start[0].gain if less is None else -np.inf, (start, less or case)))

    def shows(*start: Screened, less: Key | None = None) -> bool:
        return not one_too_many(predictor.data.rig, parent.key - {less} | {one.candidate.key for one in start})

    def tried(start: Start | tuple[tuple[Screened, ...], Key | None]) -> Fit | None:
        if isinstance(start, Start):
            return attempted(predictor, start.space, weighing, start.x, start.own, tolerance=0.5, first=FAR)
        return begun(predictor, parent, *start)

    rigid: list[Start] = []
    if grows and not content:
        rigid, search.stiffest = rigid_starts(predictor, parent, pool, search.stiffest)
    for far_start in [*rigid, *far]:
        jobs.append((f"{far_start.candidate.hypothesis.label}, far from nominal", -np.inf, far_start))
    for less in sorted(exchanges):
        others = [one for one in exchanges[less] if one.gain > WORTH_A_FIT and shows(one, less=less)
                  and not any(one.candidate.hypothesis.holds(key) for key in parent.key - {less})]
        moved = [one for one in others[effort.exchanged:] if one.candidate.key[0] == less[0]]
        for other in [*others[: effort.exchanged], *moved]:
            add((other,), less)
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
    found: dict[Causes, Fit] = {}
    expected: dict[Causes, float] = {}
    ends = predictor.pool.map(tried, [start for _, _, start in jobs])
    for k, ((label, gain, _), one) in enumerate(zip(jobs, ends, strict=True)):
        told(f"tried {label}", 0.6 * (k + 1) / len(jobs))
        if one is not None:
            search.keep(one)
            expected[one.key] = min(expected.get(one.key, np.inf), parent.objective - gain)
            if one.key not in found or one.objective < found[one.key].objective:
                found[one.key] = one
    ranked = leading(search, found, expected)[: effort.finished]
    _refit(search, [search.fits[f.key] for f in ranked], False,
           lambda share, label: told(f"fitted {label}", 0.6 + 0.4 * share), anew=not parent.key)


def held_loads(pool: Sequence[Candidate]) -> list[Screened]:
    """Friction at the load from each of its usual sizes, beside which a gap is begun as well.

    While a play is open friction alone says where the load goes; where none is it shows nothing, and by itself a gap
    behind which a light load rattles on is no better than none.
    """
    return [Screened(one, guess, 0.0, 1.0, 0.0) for one in pool if one.key == LOAD_HOLDS for guess in one.guesses]


def leading(search: Selection, found: dict[Causes, Fit], expected: dict[Causes, float]) -> list[Fit]:
    """Fits of a few steps in the order in which they are taken further: the best one, then by what they may reach.

    A fit that stopped above the objective that screening expects of its causes (``expected``) has not arrived, and may
    reach that: screening expects no more than the likelihood gives, as far as predictions are linear.
    """
    def may_reach(one: Fit) -> float:
        return search.score(one) + 0.5 * max(one.objective - expected.get(one.key, np.inf), 0.0)

    best = max(found.values(), key=search.score, default=None)
    return sorted(found.values(), key=lambda one: (one is not best, -may_reach(one)))


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


def centred(predictor: Predictor, found: Fit, complete: bool) -> tuple[Parameters, np.ndarray]:
    """A hypothesis whose effects' priors stand at the usual sizes nearest to those found, and the fit's point in it.

    Sizes are as likely about any of an effect's usual ones; where a fit happened to begin must not count.  Usual are
    those that show on rigs of which no model is quite right.  Where nothing but noise is left (``complete``) smaller
    ones show, too, and of these only the order of magnitude is unknown, as it is of what runs differ by.
    """
    space, values = found.space, found.space.values(found.x)

    def strain(cause: Key, guess: dict[str, float]) -> float:
        return sum(space.precision[i] * (coordinate.to_x(guess[coordinate.name]) - found.x[i]) ** 2
                   for i, coordinate in enumerate(space.coordinates, space.parts["effects"].start)
                   if coordinate.cause == cause)

    rig, centres = predictor.data.rig, {}
    for cls, at in space.hypothesis.effects:
        usual = cls.guesses_at(rig, at, predictor.data.speed)
        smaller = cls.smaller(usual, values[cls.name, at]) if complete else []
        centres[cls.name, at] = min([*usual, *smaller], key=partial(strain, (cls.name, at)))
    moved = parameters(predictor.data, space.hypothesis, centres)
    return moved, moved.carried(space, found.x)


def _refit(search: Selection, fits: Iterable[Fit], to_the_end: bool,
           told: Callable[[float, str], None] = lambda share, label: None, anew: bool = False) -> None:
    """Fit sets to the end, each with what runs differ by by itself, side by side; ``anew``: from nominal constants,
    too, for the rig alone bends them farthest.

    Where a set may do without (``Selection.evidence``) it is fitted so, too: what runs differ by stood in for its
    causes, and about that fit the runs do differ.  Not where it is expected to be no rival of itself then.
    """
    predictor, weighing, complete = search.predictor, search.weighing, search.complete

    def again(job: tuple[Fit, tuple[float, float]]) -> Fit | None:
        found, differ = job
        space, x = centred(predictor, found, complete)
        way = arrived if found.key in sought else attempted
        return way(predictor, space, replace(weighing, differ=differ), x, found.own, **THOROUGH,
                   to_the_end=to_the_end)

    fits, jobs = list(fits), []
    sought = {found.key for found in fits
              if anew or seeks_zeros(found.space) or not complete and has_gap(found.space)}
    sought -= search.arrived
    search.arrived |= sought
    for found in fits:
        own = search.own_weighing(found).differ
        alike = found.most_likely_differ(replace(weighing, may=(False, False)))
        jobs.append((found, own))
        if complete and alike != own:
            without = found.log_expected(replace(search.compared, differ=alike))
            if search.evidence(found) - without < CLOSE + 0.5 * MOST_GAINED:
                jobs.append((found, alike))
    for k, ((old, _), found) in enumerate(zip(jobs, predictor.pool.map(again, jobs), strict=True)):
        if found is not None:
            search.keep(found, old)
            told((k + 1) / len(jobs), found.space.hypothesis.label)


def _look_back(search: Selection, found: Fit) -> None:
    """Fit every set with one cause less, or with a simpler law in the place of one that holds it, from where the whole
    set ended: each cause must hold against its absence, and each law against those that are special cases of it."""
    search.looked_back = found.light
    hypothesis, sizes = found.space.hypothesis, found.space.values(found.x)
    less: list[tuple[Hypothesis, Sizes]] = [(hypothesis.without(cause), {}) for cause in hypothesis.causes]
    allowed = {candidate.key for candidate in candidates(search.predictor.data.rig)} - found.key
    for cls, at in hypothesis.effects:
        for (name, place), size in cls.cases(found.space.rig, at, sizes[cls.name, at]).items():
            if (name, place) in allowed:
                instead = hypothesis.without((cls.name, at)) + Hypothesis(((effect_class(name), place),))
                less.append((instead, {(name, place): size}))
    _keep_reduced(search, found, less)


def _keep_reduced(search: Selection, found: Fit, less: Sequence[tuple[Hypothesis, Sizes]]) -> None:
    """Sets that hold less than another, with sizes of what that does not hold, fitted from where that one ended; none
    that does not simulate."""
    predictor, found = search.predictor, found.light
    # What explains less may need runs to differ by as much as the rig alone does.
    share, constant = np.maximum(search.own_weighing(found).differ,
                                 search.own_weighing(search.fits[frozenset()]).differ).tolist()
    weighing = replace(search.weighing, differ=(share, constant))

    def reduced(one: tuple[Hypothesis, Sizes]) -> Fit | None:
        hypothesis, sizes = one
        space = parameters(predictor.data, hypothesis, {**found.space.values(found.space.mean), **sizes})
        return attempted(predictor, space, weighing, space.carried(found.space, found.x, sizes), found.own, **THOROUGH)

    for one in predictor.pool.map(reduced, less):
        if one is not None:
            search.keep(one)


def fitted(search: Selection, causes: Causes, whole: Causes) -> Fit:
    """The fit of some causes of a set, made where the search has not; of nothing where they do not simulate."""
    if causes not in search.fits:
        hypothesis = search.fits[whole].space.hypothesis
        for cause in whole - causes:
            hypothesis = hypothesis.without(cause)
        _keep_reduced(search, search.fits[whole], [(hypothesis, {})])
    return search.fits.get(causes, search.fits[frozenset()])


def _free(search: Selection) -> None:
    """Let runs differ where they were held alike while causes were sought: each set tells anew by how much."""
    def freed(weighing: Weighing) -> Weighing:
        return replace(weighing, may=(True, True))

    search.weighing = freed(search.weighing)
    search.fits = {key: replace(one, weighing=freed(one.weighing)) for key, one in search.fits.items()}
    search._weighed.clear()
    best = search.best()
    search.keep(fit(search.predictor, best.space, search.own_weighing(best), best.x, best.own).light, best)
    search.weigh(search.best())


def _finish(search: Selection) -> None:
    """Fit the likeliest sets to the end under a weighing that the best of them gives.

    It ends where the best is best by its own weighing, or where one comes back by whose weighing another was: that
    would never end.
    """
    _to_the_end(search)
    read = [search.reading]
    while search.wanted not in read:
        search.weigh(search.best())
        read.append(search.reading)
        _to_the_end(search)


def _to_the_end(search: Selection) -> None:
    """Fit the best set, its close rivals and its subsets to the end: none loses by where it ended.

    A best that ended in another valley is looked back upon once more: no set with less was begun there.
    """
    best = search.best()
    close = search.close(2 * search.effort.finished)
    subsets = [f for f in search.fits.values() if f.key < best.key and f not in close]
    _refit(search, [*close, *subsets], True)
    best = search.best()
    if search.looked_back is None or search.is_news(best, search.looked_back):
        _look_back(search, best)
