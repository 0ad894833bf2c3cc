"""How much of the catalogue a test makes visible.

With G the Gram matrix of what the effects at usual sizes change in the runs so far, in units of the noise and beyond
what constants within their stated uncertainty could do, and G' that of the same runs and the new one, the worth is
ln det(1 + G'/k) - ln det(1 + G/k), k the chi^2 at which an effect shows (the D-optimal design): effects that look alike
count but once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from station.diagnose.forecasts import Belief, Forecast, absorbed, nuisance_rows
from station.diagnose.planner import Judge, Planner, Worth
from station.diagnose.thresholds import VISIBLE
from station.diagnose.trials import Trial
from station.estimation.prediction import built
from station.model.effects import Effect
from station.rig import Rig
from station.runs.run import Run

PAST = 8
"""Runs whose part in what is known already is worked out, the longest."""


def told(spread: np.ndarray, change: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """(k + m, k + m) what one run says of constants and effects, its own nuisances taken out; runs add.

    From scaled rows (k, n), (m, n) and the nuisances' (channels, n).
    """
    rows = np.concatenate([spread, change])
    return absorbed(rows, nuisances) @ rows.T


def visible(known: np.ndarray, k: int) -> np.ndarray:
    """(m, m) what the effects change that the k constants within their uncertainty (unit prior) do not, of what runs
    tell (k + m, k + m); 1 where an effect shows."""
    cross = known[:k, k:]
    return (known[k:, k:] - cross.T @ np.linalg.solve(np.eye(k) + known[:k, :k], cross)) / VISIBLE


def showing(planner: Planner, base: Belief, effects: Sequence[tuple[str, Effect]], drawn: Sequence[Belief] = (),
            share: float = 1.0) -> Judge:
    """Judge trials by how much of the catalogue they make visible that the planner's runs did not.

    ``base``: where the rig stands, its axes the uncertainty before any run.  ``effects``: words and the effect at a
    usual size.  ``drawn``: where else the rig may stand; a trial must behave there too, within that ``share`` of the
    reach.
    """
    first = base.model(base.x)
    k, m = base.axes.shape[1], len(effects)
    nothing = np.zeros((k + m, k + m))
    rigs = [first.rig.with_effects((*first.rig.effects, effect)) for _, effect in effects]

    def looked(runs: Sequence[Run]) -> list[tuple[Forecast, list[np.ndarray], np.ndarray]]:
        """Per run the forecast, the outputs with each effect, and what it tells (k + m, k + m)."""
        here = planner.forecasts(base, runs)

        def outputs_of(rig: Rig) -> list[np.ndarray]:
            model = built(rig)
            return [planner.outputs(planner.simulated(model, run)) for run in runs]

        changed = list(planner.pool.map(outputs_of, rigs))
        found = []
        for r, run in enumerate(runs):
            outputs, says = [every[r] for every in changed], nothing
            if np.all(np.isfinite(here[r].mean)):
                scale = planner.scales(first, run, here[r].mean)
                change = np.stack([((output - here[r].mean) * scale).ravel() for output in outputs])
                change[~np.all(np.isfinite(change), axis=1)] = 0.0
                spread = np.nan_to_num((here[r].spread * scale).reshape(-1, scale.size), posinf=0.0, neginf=0.0)
                says = told(spread, change, nuisance_rows(scale))
            found.append((here[r], outputs, says))
        return found

    past = sum((says for _, _, says in looked(planner.runs[:PAST])), nothing)
    known = visible(past, k)
    old = np.diag(known)
    before = np.linalg.slogdet(np.eye(m) + known)[1]

    def judge(tried: list[Trial]) -> list[Worth]:
        runs = [trial.as_run(planner.rig) for trial in tried]
        daring = [planner.forecasts(other.still, runs) for other in drawn]
        found = []
        for r, (trial, run, (here, outputs, says)) in enumerate(zip(tried, runs, looked(runs), strict=True)):
            if not (planner.behaves(trial, here)
                    and all(planner.behaves(trial, forecasts[r], share) for forecasts in daring)):
                continue
            both = visible(past + says, k)
            new = np.diag(both)
            shown = int(np.sum((new >= 1.0) & (old < 1.0)))
            e = int(np.argmax(np.log1p(new) - np.log1p(old)))
            why = (f"{shown} of {m} effects of a usual size would show that the runs so far could not have shown"
                   if planner.runs and shown else f"{int(np.sum(new >= 1.0))} of {m} effects of a usual size would show"
                   ) + f", {effects[e][0]} gains most"
            found.append(planner.judged(trial, run, here, float(np.linalg.slogdet(np.eye(m) + both)[1] - before), why,
                                        (base.words, f"with {effects[e][0]}"), (here.mean, outputs[e]), shown=shown))
        return found
    return judge
