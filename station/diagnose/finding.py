"""What a search ends in: the causes that are said, the fits behind them, and what these leave."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import expit

from station.diagnose.collinear import collinear
from station.diagnose.odds import RESAMPLES, Odds, by_law, odds, resamples
from station.diagnose.refits import fitted
from station.diagnose.remainder import Remainder, remainder
from station.diagnose.result import BetweenRuns, OwnOfRun
from station.diagnose.selection import Selection
from station.diagnose.thresholds import LOG_PRIOR, OUTSIDE, STABLE, VARIES
from station.diagnose.verdict import Stated, stated
from station.estimation.cause import Causes, Key
from station.estimation.constants import refined
from station.estimation.fitted import Fit
from station.estimation.spread import differences, shared


@dataclass(frozen=True, eq=False)
class Finding:
    """What is said of the causes before runs left out are asked."""

    odds: Odds
    by_law: Odds
    """The same by which causes are stated."""
    said: Stated
    rough: Fit
    """Of the causes said, as the search left it."""
    fit: Fit
    """The same to the end: values are stated from it."""
    left: Remainder
    may_be_none: Causes = frozenset()
    """In the best set, stable, and not said: their own intervals hold that they are not there."""

    @property
    def outside(self) -> float:
        """Probability that what acts is none of the catalogue's causes."""
        return 0.0 if self.left.is_noise else OUTSIDE


def find(search: Selection) -> Finding:
    """What a search says."""
    found = odds(search)
    spoken = by_law(found)
    best = spoken.sets[0][0]
    first = _fitted(search, found, spoken, stated(spoken), best)
    if not first.left.is_noise and first.said != Stated(best):      # some are not stated, or not by themselves
        return _fitted(search, found, spoken, stated(spoken, partial(collinear, search, best)), best)
    return first


def without(search: Selection, finding: Finding, cause: Key) -> Finding:
    """What a search says where one of the causes may be none."""
    said = Stated(finding.said.causes - {cause}, finding.said.one_of - {cause})
    less = _fitted(search, finding.odds, finding.by_law, said, finding.by_law.sets[0][0])
    return replace(less, may_be_none=finding.may_be_none | {cause})


def _fitted(search: Selection, found: Odds, spoken: Odds, said: Stated, whole: Causes) -> Finding:
    """What is said, as far as it simulates."""
    rough = fitted(search, said.causes, whole)
    best = refined(search.predictor, search.own_weighing(rough), rough)
    said = Stated(rough.key, said.one_of & rough.key)
    return Finding(found, spoken, said, rough, best, remainder(search.predictor, best))


def bought(search: Selection, key: Key) -> float:
    """What a cause adds to the score of the likeliest set with it that was fitted without it, too."""
    pairs = [(found, less) for keys, found in search.fits.items()
             if key in keys and (less := search.fits.get(keys - {key})) is not None]
    if not pairs:
        return 0.0
    found, less = max(pairs, key=lambda pair: search.score(pair[0]))
    return search.score(found) - search.score(less)


def between_runs(search: Selection, finding: Finding) -> BetweenRuns:
    """In what runs differ; each as probable, before what is kept for something unknown, as a further cause would be.

    What they share is no difference between them.  By the weighing of fits, in which what runs have of their own was
    found, and whole runs count: a constant torque moves slowly.
    """
    weighing = search.weighing
    found, seen = BetweenRuns(), differences(finding.fit, weighing, resamples(search))
    own = replace(weighing, differ=(seen[0].size, seen[1].size))
    moved = finding.fit.own[:, 2:]
    for name, one, narrowing, of in zip(("share", "constant"), seen, finding.fit.log_narrowing(own), moved.T,
                                        strict=True):
        stability = float(np.mean(2.0 * one.log_odds > VARIES))
        if one.gained > VARIES and stability >= STABLE and shared(of) < VARIES:
            setattr(found, name, max(one.size, float(np.sqrt(np.mean(np.square(of))))))     # beyond the largest tried
            found.probability[name] = (1.0 - finding.outside) * float(
                np.mean(expit(one.log_odds[-RESAMPLES:] + narrowing + LOG_PRIOR)))
            found.stability[name] = stability
    if found.probability:
        found.runs = [OwnOfRun(run=run.name, share=own[2], constant=own[3])
                      for run, own in zip(search.predictor.data.runs, finding.fit.own.tolist(), strict=True)]
    return found
