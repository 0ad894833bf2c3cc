"""Which causes are stated, and the verdict, from odds, stability, what is left and what was gained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from station.diagnose.equivalences import Standing
from station.diagnose.odds import Odds
from station.diagnose.result import Verdict
from station.diagnose.screening import Screened
from station.diagnose.thresholds import SEEN, STABLE, SURE, VISIBLE
from station.estimation.cause import Causes, Key


@dataclass(frozen=True)
class Stated:
    """What is said of the causes."""

    causes: Causes
    one_of: Causes = frozenset()
    """Those of them that the data cannot tell from their rivals: something like them is there."""


def stated(found: Odds, alike: Callable[[Key], Causes] | None = None) -> Stated:
    """The causes of the best set that hold in at least STABLE of the resamples.

    One that does not, though in as many resamples it or one rival in its place is named, is stated as one of several:
    these data show that there is one, and cannot tell which.  So is, where nothing else can be stated though as many
    resamples name some cause, the best set's most stable one.  Where more than noise is left something that no
    hypothesis holds is at work, too, and what few resamples name may stand in for it: there a rival counts only where
    it does the same to the runs (``alike``, of a cause of the best set).
    """
    best = found.sets[0][0]
    stable = frozenset(key for key in best if found.stability.get(key, 0.0) >= STABLE)
    one_of = frozenset(key for key in best - stable
                       if found.in_its_place(best, key, None if alike is None else alike(key)) >= STABLE)
    if alike is None and not stable and not one_of and best and 1.0 - found.nothing >= STABLE:
        one_of = frozenset([max(sorted(best), key=lambda key: found.stability.get(key, 0.0))])
    return Stated(stable | one_of, one_of)


def verdict(said: Stated, told: Odds, screened: Sequence[Screened], is_noise: bool, against: bool,
            known: Sequence[Standing]) -> Verdict:
    """The verdict; ``against``: whether runs left out speak against the causes."""
    if not said.causes:
        if not is_noise:
            return "unexplained"
        effects = {one.candidate.key for one in screened if one.candidate.effect is not None}
        seen = {one.candidate.key for one in screened if one.information > VISIBLE}
        return "nothing_missing" if len(effects & seen) >= SEEN * len(effects) else "not_enough_data"
    if not is_noise and against:
        return "unexplained"
    if said.one_of:
        return "ambiguous"
    if not is_noise:
        return "partly_explained"
    return "ambiguous" if known or max(told.causes[key] for key in said.causes) < SURE else "explained"
