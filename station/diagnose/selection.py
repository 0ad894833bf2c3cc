"""Sets of causes and their score.

What the blocks of errors count for (``Weighing``) is read off the best set and is the same for all sets that are
compared; with it the score is a pure function of a fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from station.diagnose.effort import Effort
from station.diagnose.remainder import ahead_is_noise, may_be_noise, misses_more_ahead, remainder
from station.diagnose.screening import Screened
from station.diagnose.thresholds import CLOSE, LOG_PRIOR, LOG_PRIOR_PARAMETER, WORTH_A_FIT
from station.estimation.cause import Causes, Key, is_constant
from station.estimation.constants import told_again
from station.estimation.fitted import Fit, weighing_of
from station.estimation.least_squares import fit
from station.estimation.likelihood import Weighing
from station.estimation.parameters import CLOCK_SIGMA, Hypothesis
from station.estimation.prediction import Predictor
from station.model.effects import Stage, effect_class


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
        """Take what a fit leaves for what models of this rig leave; the fit, with the blocks that count by that.

        Whether that is noise alone is asked of the fit that takes it so, where it may be.
        """
        complete = remainder(self.predictor, found).is_noise
        if not complete and may_be_noise(self.predictor, found):
            noise = replace(found.weighing, independent=self.predictor.counts, temperature=1.0)
            again = fit(self.predictor, found.space, noise, found.x, found.own).light
            if complete := remainder(self.predictor, again).is_noise:
                found = again
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
