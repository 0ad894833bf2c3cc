"""How well a test tells rivals apart.

Hypothesis i predicts outputs y_i, with covariance S_i in units of the noise (``forecasts``).  What the log odds of i
against j are expected to gain by the mean is

    D_ij = (y_i - y_j)' (S_i^-1 + S_j^-1)/2 (y_i - y_j)

(Box and Hill 1967; Hunter and Reiner 1965 without the covariances): what a refit of the constants would absorb counts
for nothing.  exp(-D/8) bounds the share of errors that two equally likely rivals would still leave, so a test's worth
is the sum over pairs of p_i p_j (1 - exp(-D_ij/8)), over that of p_i p_j.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from station.diagnose.forecasts import Belief, absorbed, nuisance_rows
from station.diagnose.planner import Judge, Planner, Worth
from station.diagnose.trials import Trial

LOOKED = 8
"""Tests whose forecasts are worked out with their uncertainty, where rivals are to be told apart."""
FAR = 300.0
"""Scale of chi^2 without regard to refits, by which these are picked."""


def between(planner: Planner, beliefs: Sequence[Belief], odds: Sequence[float]) -> Judge:
    """Judge trials by how they tell hypotheses apart; ``odds`` are the hypotheses' probabilities."""
    pairs = [(i, j) for j in range(len(beliefs)) for i in range(j)]
    weights = np.array([odds[i] * odds[j] for i, j in pairs])
    weights /= weights.sum()

    def leading(tried: list[Trial]) -> list[Trial]:
        """The tests in which the hypotheses differ most as they stand, LOOKED of them."""
        runs = [trial.as_run(planner.rig) for trial in tried]
        still = [planner.forecasts(belief.still, runs) for belief in beliefs]
        scores = []
        for trial, forecasts in zip(tried, zip(*still, strict=True), strict=True):
            here = [forecast.mean / planner.sigma[:, None] for forecast in forecasts]
            apart = np.nan_to_num([np.sum((here[i] - here[j]) ** 2) for i, j in pairs], posinf=0.0)
            scores.append(planner.worth(trial, float(weights @ (1.0 - np.exp(-apart / FAR)))))
        return [tried[r] for r in sorted(np.argsort(-np.array(scores), kind="stable")[:LOOKED])]

    def judge(tried: list[Trial]) -> list[Worth]:
        tried = leading(tried) if len(tried) > LOOKED else tried
        runs = [trial.as_run(planner.rig) for trial in tried]
        every = zip(*(planner.forecasts(belief, runs) for belief in beliefs), strict=True)
        first = beliefs[0].model(beliefs[0].x)
        found = []
        for trial, run, here in zip(tried, runs, every, strict=True):
            if not all(planner.behaves(trial, forecast) for forecast in here):
                continue
            scale = planner.scales(first, run, here[0].mean)
            nuisances = nuisance_rows(scale)
            spreads = [np.concatenate([(forecast.spread * scale).reshape(len(forecast.spread), scale.size), nuisances])
                       for forecast in here]
            distances = []
            for i, j in pairs:
                apart = ((here[i].mean - here[j].mean) * scale).ravel()
                distances.append(0.5 * float(apart @ (absorbed(apart, spreads[i]) + absorbed(apart, spreads[j]))))
            resolved = 1.0 - np.exp(-np.maximum(distances, 0.0) / 8.0)
            p = int(np.argmax(weights * resolved))
            i, j = pairs[p]
            why = (f"{beliefs[i].words} and {beliefs[j].words} differ here by chi^2 = {distances[p]:.0f} beyond what "
                   "refitted constants could absorb")
            found.append(planner.judged(trial, run, here[0], float(weights @ resolved), why,
                                        (beliefs[i].words, beliefs[j].words), (here[i].mean, here[j].mean),
                                        distance=max(distances)))
        return found
    return judge
