"""A rig's constants from its runs: the fit that every hypothesis begins from, and that stands by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from station.estimation.dataset import first_seconds
from station.estimation.fitted import Fit, weighing_of
from station.estimation.least_squares import DIVERGED, fit
from station.estimation.likelihood import Weighing, differ_ends
from station.estimation.parameters import Hypothesis, Parameters, parameters
from station.estimation.prediction import Predictor

PRIOR_SHARE = 0.02
"""Share of all samples that count as independent before anything is known of the errors."""
FIRST_SECONDS = (0.1, 0.3, 1.0)
"""Seconds after the first command: one after the other, a period of the slowest mode of a beam apart."""
ROUGH, WORTH = 1.0, 0.2
"""Falls of -2 ln L that end a fit on the way, and one whose end is compared with others'."""
SETTLED_SHARE = 0.2
"""Change of the logarithm of a number of independent errors below which it has settled: the estimate's own error."""
ROUNDS = 4
"""Most rounds to that."""
SAME = 4.0
"""Two descents ended in one minimum where their -2 ln of the posterior differ by less."""


def base_fit(predictor: Predictor, begun: Fit | None = None) -> Fit:
    """The best rig without further causes; ``begun``: its fit ``in_step`` from nominal, where there is one already.

    A gain of a run's own can stand in for what acts on all: of a slow run for friction.  Where one would differ from
    the others' by more than a supply makes, runs are held alike in it.
    """
    space = parameters(predictor.data, Hypothesis(), {})
    found = settled(predictor, descended(predictor, space, space.mean, begun))
    shares = found.own[:, 2]
    if np.any(np.abs(shares - shares.mean()) > differ_ends(predictor.data.rig)[1, 0]):
        with suppress(*DIVERGED):
            found = settled(predictor, descended(predictor, space, space.mean, may=(False, True)))
    return found


def descended(predictor: Predictor, space: Parameters, x: np.ndarray, begun: Fit | None = None,
              may: tuple[bool, bool] = (True, True)) -> Fit:
    """The better of two fits from ``x`` (p), before anything is known of the errors; ``begun`` from there ``in_step``;
    ``may``: in what runs may differ (``Weighing.may``).

    A beam whose frequency is off swings out of step with its model after a few periods, and the objective has a valley
    for every period lost.  So fits are begun twice: on whole runs, and on longer and longer stretches after each run's
    first command, on which nothing is out of step yet.  ArithmeticError: ``x`` does not simulate.
    """
    weighing = unknown(predictor, may)
    found = [fit(predictor, space, weighing, x, tolerance=ROUGH)]
    if predictor.observers:
        with suppress(*DIVERGED):
            begun = begun or in_step(predictor, space, x, may=may)
            found.append(fit(predictor, space, weighing, begun.x, begun.own, tolerance=ROUGH))
    return min(found, key=lambda f: f.objective)


def in_step(predictor: Predictor, space: Parameters, x: np.ndarray, own: np.ndarray | None = None,
            beginnings: Sequence[float] = FIRST_SECONDS, may: tuple[bool, bool] = (True, True)) -> Fit:
    """A fit from ``x`` (p) and ``own`` (runs, 4) to longer and longer stretches after each run's first command, s: to
    the longest of them.

    ArithmeticError: ``x`` does not simulate.
    """
    own = predictor.data.own if own is None else own
    for seconds in beginnings:
        part = predictor.on(first_seconds(predictor.data, seconds))
        tolerance = WORTH if seconds == FIRST_SECONDS[-1] else ROUGH
        found = fit(part, space, unknown(part, may), x, own, tolerance=tolerance, iterations=12)
        x, own = found.x, found.own
    return found


def searched(predictor: Predictor, space: Parameters, starts: int, seed: int,
             progress: Callable[[str, float], None]) -> tuple[Fit, int]:
    """The best of several descents, from the prior's mean and from draws of it, and how many of them ended there.

    ``progress(what, share)`` is called after each.  ArithmeticError: none simulates.
    """
    rng, ends = np.random.default_rng(seed), []
    for k in range(starts):
        x = space.mean + (rng.standard_normal(space.size) / np.sqrt(space.precision) if k else 0.0)
        said = "does not simulate"
        with suppress(*DIVERGED):
            ends.append(descended(predictor, space, x))
            said = f"mean squared error {ends[-1].misfit:.4g} times the noise's"
        progress(f"start {k + 1} of {starts}: {said}", (k + 1) / starts)
    if not ends:
        raise ArithmeticError("no start simulates")
    best = min(ends, key=lambda end: end.objective)
    return best, sum(end.objective < best.objective + SAME for end in ends)


def unknown(predictor: Predictor, may: tuple[bool, bool] = (True, True)) -> Weighing:
    """What blocks count for before anything is known of the errors; runs may differ by as much as they ever do, in what
    they ``may``.

    By how much they do is read off what a fit gives each run: off one that gives them nothing, nothing can be.
    """
    share, constant = np.where(may, *differ_ends(predictor.data.rig)[::-1]).tolist()
    return Weighing(PRIOR_SHARE * predictor.counts, 1.0, (share, constant), may)


def settled(predictor: Predictor, found: Fit) -> Fit:
    """A fit under the weighing that its own errors give (``weighing_of``)."""
    for _ in range(ROUNDS):
        before = found.weighing
        now = weighing_of(predictor, found)
        found = fit(predictor, found.space, now, found.x, found.own, jacobian=found.jacobian)
        if np.all(np.abs(now.independent - before.independent) <= SETTLED_SHARE * before.independent):
            break
    return found


def told_again(predictor: Predictor, found: Fit) -> Fit:
    """A fit as other observers tell it, where it ended."""
    weighing = replace(unknown(predictor, found.weighing.may), differ=found.weighing.differ)
    return fit(predictor, found.space, weighing, found.x, found.own, iterations=0).light


def cooled(predictor: Predictor, found: Fit) -> Weighing:
    """A fit's weighing, its temperature at least the number of times that horizons count the same readings.

    The horizons' errors are of the same readings, so that together they say no more than the one that says most.  With
    H the curvature of all blocks, H_h without the encoder's at other horizons than h, and A = H + prior's precision, so
    many times is the least of tr(A^-1 H)/tr(A^-1 H_h).  In runs of a few seconds the scatter of the slope over their
    few stretches does not show it.
    """
    encoder = np.flatnonzero(predictor.channel == 0)
    cold, blocks = replace(found.weighing, temperature=1.0), np.arange(found.counts.shape[1])
    whole = found.normal(cold)[0]
    inverse = np.linalg.inv(whole + np.diag(found.space.precision))
    most = 0.0
    for horizon in encoder:
        kept = ~np.isin(blocks, encoder) | (blocks == horizon)
        most = max(most, float(np.trace(inverse @ found.normal(replace(cold, independent=cold.independent * kept))[0])))
    times = float(np.trace(inverse @ whole)) / most if most > 0.0 else 1.0
    return replace(found.weighing, temperature=max(found.weighing.temperature, times))


def refined(predictor: Predictor, weighing: Weighing, found: Fit) -> Fit:
    """A fit brought to its very end with finer simulations: values are stated from it."""
    finer = replace(predictor, accuracy=predictor.final)
    return fit(finer, found.space, weighing, found.x, found.own, iterations=100, tolerance=0.05,
               renewals=40, to_the_end=True)
