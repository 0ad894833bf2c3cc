"""How far a search goes."""

from __future__ import annotations

from dataclasses import dataclass

from station.estimation.prediction import COARSE, FINE, SEARCH, Accuracy


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
