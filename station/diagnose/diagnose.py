"""The diagnosis: what the simulation gets wrong, why, and what the better rig buys on unseen runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from station.diagnose.equivalences import SURE, Standing, completed, rivals, standing, with_word
from station.diagnose.estimate import Fit
from station.diagnose.evidence import evidence
from station.diagnose.experiment import choose
from station.diagnose.heldout import gain, leave_each_out, mean_error, settle, simulate_all, simulate_unseen
from station.diagnose.measures import floor, nrmse, step_measures
from station.diagnose.posterior import Odds, estimates, normalised, odds
from station.diagnose.problem import FEATURES, Problem
from station.diagnose.remainder import Remainder, remainder
from station.diagnose.result import (
    Cause,
    Diagnosis,
    DiagnosisResult,
    Gain,
    RankedCause,
    RunComparison,
    Verdict,
    Wrong,
)
from station.diagnose.search import EFFORTS, Search, explore, refined
from station.diagnose.unseen import refuted, unseen_gain
from station.errors import UsageError, WorkError
from station.model.simulate import Simulation
from station.rig import Rig
from station.runs.run import Run

WORTH = 0.3
"""Prior odds of each further cause where held-out errors decide: it must take two percent off them."""
LEADING = 6
"""Sets of causes that are judged on runs left out where held-out errors decide."""
BRIEF: dict[str, Any] = {"iterations": 4, "renewals": 0}
"""Held-out fits where sets of causes are compared, and those of a quick diagnosis: first steps go most of the way."""
LIKELY = 0.01
"""Probability of a cause from which on what it buys on unseen runs is worked out for the table, wherever it stands."""
FEW = 3
"""Runs below which even a settled verdict asks for another test."""
LeftOut = dict[frozenset, list[Fit]]
"""By set of causes, the fits that left out run after run."""
VISIBLE = 25.0
"""chi^2 at which an effect of a plain size shows."""


def diagnose(rig: Rig, runs: Sequence[Run], effort: str = "full",
             progress: Callable[[str, float], None] | None = None, threads: int = 2) -> DiagnosisResult:
    """Diagnose a rig from its runs; more ``threads`` than two gain little.

    UsageError for an unknown effort; WorkError where the runs cannot be used (rate, no motion).
    """
    begun = time.perf_counter()
    if effort not in EFFORTS:
        raise UsageError(f"--effort: {effort!r} is none of {', '.join(EFFORTS)}")
    report = progress or (lambda text, share: None)
    given = len(runs)
    runs, windows = _usable(rig, runs)
    problem = Problem(rig, runs, threads, windows)
    search = explore(problem, EFFORTS[effort], report)
    nothing = search.fits[frozenset()]
    report("judging on runs left out", 0.92)
    how = {} if search.effort.thorough else BRIEF
    found_odds, best, left_out = (_odds_unseen if search.misfit else _odds_upheld)(search, how)
    best_keys = found_odds.sets[0][0]
    zero = np.zeros(nothing.layout.size)
    start, offset = settle(problem, nothing.layout, zero, problem.start, problem.offset)
    before = simulate_all(problem, nothing.layout, zero, start, offset)
    after = simulate_unseen(problem, left_out[best_keys])
    refit = after if not best_keys else simulate_unseen(problem, left_out[frozenset()])
    names = [run.name for run in runs]
    bought = gain(problem, names, before, after)
    left = remainder(problem, best)
    values, constants = estimates(search, best, search.fits[best_keys])
    known = standing(problem, best_keys, problem.rig_of(best.layout, best.x))
    told, ranked = completed(found_odds, best_keys, known), found_odds
    if not left.is_noise:
        told, ranked = (each.doubted(bought.explained_fraction or 0.0) for each in (told, ranked))
    verdict = _verdict(search, told, best_keys, left, gain(problem, names, refit, after), bought, known)
    causes = []
    if verdict in ("explained", "partly_explained", "ambiguous"):
        for key in _in_order(search, best_keys, told):
            causes.append(Cause(effect=key[0], at=key[1], probability=min(told.causes[key], 1.0),
                                parameters=values[key], rivals=rivals(told, best_keys, key, known)))
    extended = problem.rig_of(best.layout, best.x) if causes else problem.rig_of(nothing.layout, nothing.x)
    refit_rig = problem.rig_of(nothing.layout, nothing.x)
    shown: list[Simulation | None] = list(after) if causes else [None] * len(runs)
    comparisons = [RunComparison(run, b, r, a) for run, b, r, a in zip(runs, before, refit, shown, strict=True)]
    report("choosing the next experiment", 0.96)
    choice = choose(search, found_odds, verdict)
    decided = verdict in ("explained", "nothing_missing") and given >= FEW
    diagnosis = Diagnosis(verdict=verdict, wrong=_wrong(runs, before, problem.noise), causes=causes, gain=bought,
                          next_experiment=with_word(None if decided else choice.next, verdict, told, best_keys, known))
    ranking = _ranking(search, ranked, left_out)
    pictures = evidence(refit_rig, extended, runs[:1] if windows else runs, [(c.effect, c.at) for c in causes])
    report("done", 1.0)
    return DiagnosisResult(diagnosis, rig, refit_rig, extended, comparisons, ranking, pictures, constants,
                           _notes(rig, search, left), time.perf_counter() - begun,
                           choice.plan, choice.unseen, choice.prediction,
                           [row.equivalence.sentence for row in known] if causes else [])


def _odds_upheld(search: Search, how: dict[str, Any]) -> tuple[Odds, Fit, LeftOut]:
    """Odds of the sets of causes that runs left out do not refute, with the best set, and the fits that left runs out.

    The best set is held against each set with one cause less; where runs speak against it the next best is.
    """
    problem, temperature, left_out = search.problem, search.temperature(), {}

    def once(keys: frozenset) -> list[Fit]:
        if keys not in left_out:
            left_out[keys] = leave_each_out(problem, search.fits[keys], **how)
        return left_out[keys]

    once(frozenset())
    while True:
        found = odds(search)
        keys = found.sets[0][0]
        best = refined(problem, search.fits[keys])
        if keys:
            left_out[keys] = leave_each_out(problem, best, **how)
        smaller = [keys - {key} for key in keys if keys - {key} in search.fits]
        if not any(refuted(once(rest), left_out[keys], temperature) for rest in smaller):
            return found, best, left_out
        search.refuted.add(keys)


def _odds_unseen(search: Search, how: dict[str, Any]) -> tuple[Odds, Fit, LeftOut]:
    """Odds of the leading sets of causes by how well they predict runs left out, where none reaches the noise.

    Each set's weight is (its held-out error)^-FEATURES, as of FEATURES independent errors, times WORTH per cause.
    """
    problem = search.problem
    leading = [keys for keys, _ in odds(search).sets[:LEADING]]
    tried = [*leading, *([] if frozenset() in leading else [frozenset()])]
    left_out, scores = {}, {}
    for keys in tried:
        left_out[keys] = leave_each_out(problem, search.fits[keys], **BRIEF)
        error = mean_error(problem, simulate_unseen(problem, left_out[keys]))
        scores[keys] = -FEATURES * np.log(error) + np.log(WORTH) * len(keys)
    found = normalised(scores)
    keys = found.sets[0][0]
    best = refined(problem, search.fits[keys])
    left_out[keys] = leave_each_out(problem, best, **how)
    if keys:
        left_out[frozenset()] = leave_each_out(problem, search.fits[frozenset()], **how)
    return found, best, left_out


def _in_order(search: Search, best: frozenset, found: Odds) -> list[tuple[str, str]]:
    """The causes of the best set by probability, as far as it is printed, then by what each buys beside the others."""
    def bought(key: tuple[str, str]) -> float:
        rest = search.fits.get(best - {key})
        return rest.objective - search.fits[best].objective if rest is not None else 0.0
    return sorted(best, key=lambda key: (-round(found.causes[key], 2), -bought(key)))


def _usable(rig: Rig, runs: Sequence[Run]) -> tuple[list[Run], list[slice] | None]:
    """The runs, checked; a run that is alone is judged half by half."""
    if not runs:
        raise UsageError("diagnose: at least one run is wanted")
    for run in runs:
        if abs(run.sample_rate / rig.sample_rate - 1.0) > 0.01:
            raise WorkError(f"{run.name}: sampled at {run.sample_rate:.6g} Hz, the rig at {rig.sample_rate:.6g} Hz")
        if hasattr(run, "require_unbroken"):
            run.require_unbroken()
        if rig.accelerometer is not None and run.accel is None:
            raise WorkError(f"{run.name}: no accelerometer column, but rig {rig.name} has an accelerometer")
    if len(runs) > 1:
        return list(runs), None
    half = len(runs[0].t) // 2
    return ([replace(runs[0], name=f"{runs[0].name} ({part} half)") for part in ("first", "second")],
            [slice(0, half), slice(half, None)])


def _verdict(search: Search, found: Odds, best: frozenset, left: Remainder, over_refit: Gain, over_nominal: Gain,
             known: Sequence[Standing]) -> Verdict:
    if not best:
        if not left.is_noise:
            return "unexplained"
        plain = {}
        for promise in search.promises:
            if promise.candidate.effect is not None:
                key = promise.candidate.key
                plain[key] = max(plain.get(key, 0.0), promise.information)
        seen = sum(value > VISIBLE for value in plain.values())
        return "nothing_missing" if seen >= 0.5 * len(plain) else "not_enough_data"
    first = max(found.causes[key] for key in best)
    if not left.is_noise:
        share = over_nominal.explained_fraction
        if over_refit.explained_fraction is None or over_refit.explained_fraction < 0.3 or share is None:
            return "unexplained"
        return "partly_explained"
    return "ambiguous" if known or first < SURE else "explained"


def _wrong(runs: Sequence[Run], before: Sequence[Simulation], noise: Sequence[float]) -> list[Wrong]:
    """What the nominal rig gets wrong, the largest first; beside an nrmse stands the floor that noise alone sets."""
    found = []
    for run, simulation in zip(runs, before, strict=True):
        count = 100.0 / max(np.ptp(run.reference), 1.0)
        measured, simulated = step_measures(run, run.encoder), step_measures(run, simulation.encoder)
        for name in measured:
            m, s = measured[name], simulated[name]
            if name == "overshoot_percent" and m is not None and s is not None and abs(m - s) > 1.5 * count:
                found.append((abs(m - s), Wrong(run=run.name, channel="encoder", measure=name, simulated=s,
                                                measured=m)))
            elif name == "settling_time" and m != s and (m is None or s is None or abs(m - s) > 0.05):
                found.append((0.0, Wrong(run=run.name, channel="encoder", measure=name, simulated=s, measured=m)))
        if not measured:
            peak_m, peak_s = float(np.max(np.abs(run.encoder))), float(np.max(np.abs(simulation.encoder)))
            if abs(peak_m - peak_s) > 2.0:
                found.append((100.0 * abs(peak_m - peak_s) / max(peak_m, 1.0),
                              Wrong(run=run.name, channel="encoder", measure="peak_counts", simulated=peak_s,
                                    measured=peak_m)))
        for channel, sigma in zip(("encoder", "accel"), noise, strict=True):
            m, s = getattr(run, channel), getattr(simulation, channel)
            if m is None or s is None:
                continue
            misfit = nrmse(m, s)
            if misfit > 0.1:
                worst = int(np.argmax(np.abs(m - s)))
                found.append((misfit, Wrong(run=run.name, channel=channel, measure="nrmse", simulated=misfit,
                                            measured=floor(m, sigma), where=f"largest at t = {run.t[worst]:.3f} s")))
    return [wrong for _, wrong in sorted(found, key=lambda row: -row[0])]


def _ranking(search: Search, found: Odds, left_out: LeftOut) -> list[RankedCause]:
    """Every cause that was fitted, by probability, then by how much it bought alone.

    Its gain on unseen runs is told where fits have left them out: of the best set, of what it was held against, and
    here of what is likely.
    """
    nothing, temperature = search.fits[frozenset()], search.temperature()
    rows = []
    for key in dict.fromkeys([*(key for keys in search.fits if len(keys) == 1 for key in keys), *found.causes]):
        probability, alone = found.causes.get(key, 0.0), frozenset({key})
        keys = alone if alone in search.fits else min((k for k in search.fits if key in k),
                                                      key=lambda k: search.fits[k].objective)
        fitted = search.fits[keys]
        if keys not in left_out and probability > LIKELY:
            left_out[keys] = leave_each_out(search.problem, fitted, **BRIEF)
        gained = unseen_gain(left_out[frozenset()], left_out[keys]) if keys in left_out else None
        rows.append(RankedCause(key[0], key[1], probability, (nothing.chi2 - fitted.chi2) / temperature, gained,
                                estimates(search, fitted)[0].get(key, {}),
                                note="" if keys == alone else f"as part of {fitted.layout.hypothesis.label}"))
    return sorted(rows, key=lambda r: (-r.probability, -r.delta_chi2))


def _notes(rig: Rig, search: Search, left: Remainder) -> list[str]:
    problem = search.problem
    notes = [f"{len(search.fits)} sets of causes fitted to {len(problem.runs)} runs",
             f"noise at rest: encoder {problem.noise[0]:.2f}, accelerometer {problem.noise[1]:.2f} counts",
             f"scale of what the best set leaves: {search.temperature():.2f} of the noise's variance"]
    if rig.beam is not None and problem.rig.beam.elements != rig.beam.elements:
        notes.append(f"simulated with {problem.rig.beam.elements} beam elements; with the {rig.beam.elements} of the "
                     "rig file the mesh's own error would look like physics")
    for r, run in enumerate(problem.runs):
        for c, channel in enumerate(("encoder", "accel")[: problem.channels]):
            if max(left.size[r, c], left.slow[r, c]) > 6.0:
                notes.append(f"{run.name}: {channel} is left with more than noise "
                             f"({left.size[r, c]:.0f} sigma in size, {left.slow[r, c]:.0f} sigma in slow motion)")
    return notes

