"""Which causes are stated, and the verdict, from odds, stability, what is left and what was gained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from station.diagnose.equivalences import Standing
from station.diagnose.odds import Odds
from station.diagnose.result import Verdict
from station.diagnose.screening import Screened
from station.diagnose.thresholds import STABLE, SURE, VISIBLE
from station.estimation.parameters import Causes


@dataclass(frozen=True)
class Stated:
    """What is said of the causes."""

    causes: Causes
    ambiguous: bool
    """Whether the data show that something is missing, but cannot tell the first cause from its rivals."""


def stated(found: Odds) -> Stated:
    """The causes of the best set that hold in at least STABLE of the resamples.

    Where none does, though in as many some cause is named, these data cannot tell the rivals apart: the best set's most
    stable cause is stated, as one of several.
    """
    best = found.sets[0][0]
    stable = frozenset(key for key in best if found.stability.get(key, 0.0) >= STABLE)
    if stable or not best:
        return Stated(stable, False)
    if 1.0 - found.nothing >= STABLE:
        first = max(sorted(best), key=lambda key: found.stability.get(key, 0.0))
        return Stated(frozenset([first]), True)
    return Stated(frozenset(), False)


def verdict(said: Stated, told: Odds, screened: Sequence[Screened], is_noise: bool, against: bool,
            known: Sequence[Standing]) -> Verdict:
    """The verdict; ``against``: whether runs left out speak against the causes."""
    if not said.causes:
        if not is_noise:
            return "unexplained"
        plain: dict[tuple[str, str], float] = {}
        for one in screened:
            if one.candidate.effect is not None:
                plain[one.candidate.key] = max(plain.get(one.candidate.key, 0.0), one.information)
        seen = sum(value > VISIBLE for value in plain.values())
        return "nothing_missing" if seen >= 0.5 * len(plain) else "not_enough_data"
    if not is_noise and (said.ambiguous or against):
        # Where more than noise is left something that no hypothesis holds is at work, too, and what few resamples name
        # may stand in for it.
        return "unexplained"
    if said.ambiguous:
        return "ambiguous"
    if not is_noise:
        return "partly_explained"
    return "ambiguous" if known or max(told.causes[key] for key in said.causes) < SURE else "explained"
