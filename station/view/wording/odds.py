"""Where the probability lies that a cause does not hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.diagnose.thresholds import SURE
from station.view.wording.names import cause_title, place
from station.view.wording.numbers import probability

if TYPE_CHECKING:
    from station.diagnose.result import Cause


def as_good_as_certain(outside: float) -> float:
    """The probability from which on a thing is told without a hedge; ``outside``: what is kept for none that is known.
    """
    return SURE * (1.0 - outside)


def rest_sentence(cause: Cause, outside: float) -> str:
    """Where the probability lies that a cause does not hold (``outside``: what is kept for none that is known), and
    where else a law may act that may act at several places; empty where hardly anything is left.

    Rivals may stand beside each other in one set, so that theirs may add up to more.
    """
    places = [r for r in cause.rivals if r.effect == cause.effect]
    instead = [r for r in cause.rivals if r.effect != cause.effect]
    words = []
    if places:
        words.append(f"Instead of {place(cause.at)} it may act "
                     f"{' or '.join(f'{place(r.at)} ({probability(r.probability)})' for r in places)}.")
    rest = 1.0 - cause.probability - outside
    if rest >= 0.005:
        among = [f"{cause_title(r.effect, r.at)} ({probability(r.probability)})" for r in instead]
        left = rest - sum(r.probability for r in instead)
        beside = f"; {probability(left)} with none of these" if left > 0.005 else ""
        words.append(f"The other {probability(rest)}: sets of causes without it, "
                     + (f"among them with {', '.join(among)}{beside}." if among else
                        "none of them with a likely cause in its place."))
    return " ".join(words)


def outside_sentence(outside: float) -> str:
    """What is kept for causes that no effect describes; empty where only noise is left."""
    return (f"More than noise is left, so {probability(outside)} is kept for something that acts like these causes and "
            "is none that is known here.") if outside else ""
