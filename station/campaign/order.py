"""In which order the cases of a campaign are done, so that those that are done are always a fair sample of all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def by_share(weights: Mapping[str, float]) -> Iterator[str]:
    """Names without end, each as often as its weight says; next comes the one that is furthest behind."""
    there = {name: weight for name, weight in weights.items() if weight > 0.0}
    total, given, count = sum(there.values()), dict.fromkeys(there, 0), 0
    while there:
        count += 1
        name = max(there, key=lambda n: there[n] * count / total - given[n])
        given[name] += 1
        yield name


def in_turn(items: Sequence[Item], rng: np.random.Generator) -> Iterator[Item]:
    """Each as often as any other, every round in a new order; nothing where there are none."""
    while items:
        yield from (items[i] for i in rng.permutation(len(items)))
