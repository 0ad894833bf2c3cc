"""The diagnosis: what the simulation gets wrong, why, and what the better rig buys on unseen runs."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.special import expit
from threadpoolctl import threadpool_limits

from station.diagnose.collinear import collinear
from station.diagnose.equivalences import completed, rivals, standing, with_word
from station.diagnose.experiment import choose
from station.diagnose.measures import floor, nrmse, step_measures
from station.diagnose.odds import RESAMPLES, Odds, by_law, estimates, in_order, odds, resamples, with_outside
from station.diagnose.remainder import Remainder, remainder
from station.diagnose.result import (
    BetweenRuns,
    Cause,
    Diagnosis,
    DiagnosisResult,
    Disturbance,
    OwnOfRun,
    Ranked,
    RankedCause,
    RunComparison,
    RunFile,
    Wrong,
)
from station.diagnose.selection import EFFORTS, Selection, fitted, select
from station.diagnose.thresholds import (
    FEW,
    LOG_PRIOR,
    NOISE,
    OUTSIDE,
    SHOWN_COUNTS,
    SHOWN_SETTLING,
    SHOWN_SHARE,
    STABLE,
    VARIES,
)
from station.diagnose.validation import (
    contradicted,
    gain,
    leave_each_out,
    log_densities,
    predicted_ahead,
    relief,
    seconds_ahead,
    simulate_runs,
    simulate_unseen,
    standard_error,
    unseen_gain,
)
from station.diagnose.verdict import Stated, stated, verdict
from station.errors import UsageError, WorkError
from station.estimation.constants import refined
from station.estimation.dataset import canonical_order, dataset
from station.estimation.least_squares import CANNOT_SIMULATE, DIVERGED, Fit
from station.estimation.observer import observers
from station.estimation.parameters import Causes, Key
from station.estimation.prediction import SEARCH, Predictor, predict_run
from station.estimation.spread import differences
from station.model.simulate import Simulation, build
from station.rig import Rig
from station.runs.run import Run

if TYPE_CHECKING:
    from station.pictures.evidence import Evidence

THREADS = 2
TURN = 1e-4
"""Seconds after which a thread that runs Python lets another one do so: what a short prediction takes (Python's own
5 ms leave the threads idle by turns)."""


def diagnose(rig: Rig, runs: Sequence[Run], effort: str = "full",
             progress: Callable[[str, float], None] | None = None, threads: int = THREADS) -> DiagnosisResult:
    """Diagnose a rig from its runs; more ``threads`` than two gain little.

    The same runs give the same answer, whatever their order, the number of threads or the linear algebra's: runs are
    taken in the order of their content, and linear algebra by one thread.  UsageError for an unknown effort; WorkError
    where the runs cannot be used (rate, columns), or not be simulated.
    """
    begun = time.perf_counter()
    if effort not in EFFORTS:
        raise UsageError(f"--effort: {effort!r} is none of {', '.join(EFFORTS)}")
    order = canonical_order(runs) if runs else []
    with threadpool_limits(1), _taking_turns(), ThreadPoolExecutor(threads) as pool:
        found = _diagnose(rig, [runs[i] for i in order], effort, progress or (lambda text, share: None), pool)
    return _in_order_of(found, [runs[i].name for i in order], order, time.perf_counter() - begun)


@contextmanager
def _taking_turns() -> Iterator[None]:
    """Let no thread that comes back from compiled code wait for Python longer than that code took."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(TURN)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _diagnose(rig: Rig, given: Sequence[Run], effort: str, report: Callable[[str, float], None],
              pool: ThreadPoolExecutor) -> DiagnosisResult:
    runs, windows = _usable(rig, given)
    data = dataset(rig, runs, windows)
    predictor = Predictor(data, observers(data.rig, data.noise[0]), pool, *EFFORTS[effort].accuracies)
    try:
        search = select(predictor, EFFORTS[effort], report)
    except DIVERGED:
        raise WorkError(f"{rig.name}: {CANNOT_SIMULATE}") from None
    report("drawing the data again", 0.88)
    found = odds(search)
    spoken = by_law(found)
    said = stated(spoken)
    nothing = search.fits[frozenset()]
    said, chosen, best, left = _fitted(search, said, spoken.sets[0][0])
    if said.one_of and not left.is_noise:
        said = stated(spoken, partial(collinear, search, spoken.sets[0][0]))
        said, chosen, best, left = _fitted(search, said, spoken.sets[0][0])
    report("judging on runs left out", 0.92)
    left_out = {said.causes: leave_each_out(predictor, best.weighing, best)}
    left_out.setdefault(frozenset(), leave_each_out(predictor, search.own_weighing(nothing), nothing))
    zero = np.zeros(nothing.space.size)
    before = simulate_runs(data, nothing.space, zero, data.own)
    refit = simulate_unseen(predictor, left_out[frozenset()])
    after = simulate_unseen(predictor, left_out[said.causes]) if said.causes else refit
    names, parts = [run.name for run in runs], windows or [slice(None)] * len(runs)
    ahead = (predicted_ahead(predictor, nothing, nominal=True), predicted_ahead(predictor, left_out[said.causes]))
    bought = gain(data, names, before, after, ahead, parts)
    densities = {keys: log_densities(predictor, search.weighing, fits) for keys, fits in left_out.items()}
    gains = densities[said.causes] - densities[frozenset()]
    relieved = (relief(left_out[frozenset()], left_out[said.causes]) + search.clock_score(best.space.hypothesis)
                - search.clock_score(nothing.space.hypothesis))
    against = contradicted(gains, relieved)
    values, constants = estimates(best, chosen, left_out[said.causes])
    known = standing(data, said.causes, best.space.rig_at(best.x))
    told = completed(found, said.causes, known) if said.causes in dict(found.sets) else found
    decision = verdict(said, told, search.screened, left.is_noise, against, known)
    named = decision in ("explained", "partly_explained", "ambiguous")
    if named:
        laws = {key: spoken.causes[key] for key in said.causes if spoken.causes[key] != found.causes.get(key)}
        told = replace(told, causes={**told.causes, **laws})
        order, told = in_order(told, said.causes, partial(_bought, search, said.causes))
    if not left.is_noise:
        told = with_outside(told)
    causes = [Cause(effect=key[0], at=key[1], probability=min(told.causes[key], 1.0), parameters=values[key],
                    stability=min(spoken.stability.get(key, 0.0), 1.0), rivals=rivals(told, said.causes, key, known))
              for key in order] if named else []
    extended = best.space.rig_at(best.x) if causes else nothing.space.rig_at(nothing.x)
    refit_rig = nothing.space.rig_at(nothing.x)
    shown: list[Simulation | None] = list(after) if causes else [None] * len(runs)
    comparisons = [RunComparison(run, b, r, a, seconds_ahead(data, k), part)
                   for k, (run, b, r, a, part) in enumerate(zip(runs, before, refit, shown, parts, strict=True))]
    report("choosing the next experiment", 0.96)
    choice = choose(search, found, decision)
    decided = decision in ("explained", "nothing_missing") and len(given) >= FEW
    ranking = _ranking(search, told, densities)
    between = _between(search, chosen, [OwnOfRun(run=name, share=own[2], constant=own[3])
                                        for name, own in zip(names, best.own.tolist(), strict=True)],
                       1.0 if left.is_noise else 1.0 - OUTSIDE)
    diagnosis = Diagnosis(
        verdict=decision, wrong=_wrong(comparisons, data.noise), causes=causes, gain=bought,
        next_experiment=with_word(None if decided else choice.next, decision, told, said.causes, known),
        outside=0.0 if left.is_noise else OUTSIDE,
        disturbance=_disturbance(predictor, [data.rig, refit_rig, extended]), between_runs=between, rig=rig.name,
        effort=effort,
        runs=[RunFile(run=run.name) for run in given],
        ranking=[Ranked(effect=r.effect, at=r.at, probability=min(r.probability, 1.0), note=r.note) for r in ranking])
    drawn = [run for run, warm in zip(runs, data.warm, strict=True) if not warm]
    drawn = [replace(run, name=given[0].name) for run in drawn[:1]] if windows else drawn
    draw = partial(_drawn, refit_rig, extended, drawn, [(c.effect, c.at) for c in causes])
    report("done", 1.0)
    return DiagnosisResult(diagnosis, rig, refit_rig, extended, comparisons, ranking, draw, constants,
                           _notes(rig, search, left, said, spoken, gains + relieved / len(gains)), 0.0,
                           choice.plan, choice.unseen, choice.prediction,
                           [row.equivalence.sentence for row in known] if causes else [])


def _drawn(rig: Rig, extended: Rig, runs: Sequence[Run], causes: Sequence[tuple[str, str]]) -> list[Evidence]:
    from station.pictures.evidence import evidence  # slow to import, and not always wanted

    with threadpool_limits(1), ThreadPoolExecutor(THREADS) as pool:
        return evidence(rig, extended, runs, causes, pool) if runs else []


def _fitted(search: Selection, said: Stated, whole: Causes) -> tuple[Stated, Fit, Fit, Remainder]:
    """What is said, as far as it simulates, its fit, the same to the end, and what that leaves."""
    chosen = fitted(search, said.causes, whole)
    best = refined(search.predictor, search.own_weighing(chosen), chosen)
    return Stated(chosen.key, said.one_of & chosen.key), chosen, best, remainder(search.predictor, best)


def _in_order_of(found: DiagnosisResult, names: list[str], order: list[int], seconds: float) -> DiagnosisResult:
    """The result with its runs in the order in which they were given."""
    place = {name: order[k] for k, name in reversed(list(enumerate(names)))}

    def by_run(row: object) -> int:
        return place.get(str(row), place.get(str(row).rsplit(" (", 1)[0], 0))    # of one run "(first half)"

    diagnosis = found.diagnosis.model_copy(update={
        "runs": sorted(found.diagnosis.runs, key=lambda r: by_run(r.run)),
        "between_runs": found.diagnosis.between_runs and found.diagnosis.between_runs.model_copy(update={
            "runs": sorted(found.diagnosis.between_runs.runs, key=lambda r: by_run(r.run))}),
        "gain": found.diagnosis.gain.model_copy(update={
            "held_out": sorted(found.diagnosis.gain.held_out, key=by_run),
            "runs": sorted(found.diagnosis.gain.runs, key=lambda r: by_run(r.run))})})
    return replace(found, diagnosis=diagnosis, seconds=seconds,
                   comparisons=sorted(found.comparisons, key=lambda c: by_run(c.run.name)))


def _bought(search: Selection, best: Causes, key: Key) -> float:
    """What a cause adds to the score of a set."""
    rest = search.fits.get(best - {key})
    return search.score(search.fits[best]) - search.score(rest) if rest is not None else 0.0


def _between(search: Selection, found: Fit, runs: list[OwnOfRun], inside: float) -> BetweenRuns:
    """In what runs differ; each as probable, before what is kept for something unknown, as a further cause would be."""
    told = {}
    for name, seen in zip(("share", "constant"), differences(found, search.weighing, resamples(search)), strict=True):
        stability = float(np.mean(2.0 * seen.log_odds > VARIES))
        if seen.gained > VARIES and stability >= STABLE:
            told[name] = seen.size, inside * float(np.mean(expit(seen.log_odds[-RESAMPLES:] + LOG_PRIOR))), stability
    return BetweenRuns(**{name: size for name, (size, _, _) in told.items()},
                       probability={name: probability for name, (_, probability, _) in told.items()},
                       stability={name: stability for name, (_, _, stability) in told.items()},
                       runs=runs if told else [])


def _usable(rig: Rig, runs: Sequence[Run]) -> tuple[list[Run], list[slice] | None]:
    """The runs, checked, their gaps filled; a run that is alone is judged half by half."""
    if not runs:
        raise UsageError("diagnose: at least one run is wanted")
    for run in runs:
        if rig.accelerometer is not None and run.accel is None:
            raise WorkError(f"{run.name}: no accelerometer column, but rig {rig.name} has an accelerometer")
    runs = [run.filled(rig.sample_rate) for run in runs]
    if len(runs) > 1:
        return runs, None
    half = len(runs[0].t) // 2
    return ([replace(runs[0], name=f"{runs[0].name} ({part} half)") for part in ("first", "second")],
            [slice(0, half), slice(half, None)])


def _wrong(comparisons: Sequence[RunComparison], noise: Sequence[float]) -> list[Wrong]:
    """What the nominal rig gets wrong, the largest first; beside an nrmse stands the floor that noise alone sets."""
    found = []
    for c in comparisons:
        run, simulation, rows = c.run, c.before, c.rows
        count = 100.0 / max(np.ptp(run.reference), 1.0)
        measured, simulated = (step_measures(run, encoder, c.part) for encoder in (run.encoder, simulation.encoder))
        for name in measured:
            m, s = measured[name], simulated[name]
            if name == "overshoot_percent" and m is not None and s is not None and abs(m - s) > SHOWN_COUNTS * count:
                found.append((abs(m - s), Wrong(run=run.name, channel="encoder", measure=name, simulated=s,
                                                measured=m)))
            elif name == "settling_time" and m != s and (m is None or s is None or abs(m - s) > SHOWN_SETTLING):
                found.append((0.0, Wrong(run=run.name, channel="encoder", measure=name, simulated=s, measured=m)))
        if not measured:
            peak_m, peak_s = (float(np.max(np.abs(encoder[rows]))) for encoder in (run.encoder, simulation.encoder))
            if abs(peak_m - peak_s) > SHOWN_COUNTS:
                found.append((100.0 * abs(peak_m - peak_s) / max(peak_m, 1.0),
                              Wrong(run=run.name, channel="encoder", measure="peak_counts", simulated=peak_s,
                                    measured=peak_m)))
        channels: tuple[Literal["encoder", "accel"], ...] = ("encoder", "accel")
        for channel, sigma in zip(channels, noise, strict=True):
            m, s = getattr(run, channel), getattr(simulation, channel)
            if m is None or s is None:
                continue
            misfit = nrmse(m[rows], s[rows])
            if SHOWN_SHARE < misfit < np.inf:       # of a channel that never moves there is none
                worst = int(np.argmax(np.abs(m - s) * rows))
                found.append((misfit, Wrong(run=run.name, channel=channel, measure="nrmse", simulated=misfit,
                                            measured=floor(m[rows], sigma),
                                            where=f"largest at t = {run.t[worst]:.3f} s")))
    return [wrong for _, wrong in sorted(found, key=lambda row: -row[0])]


def _ranking(search: Selection, found: Odds, densities: dict[Causes, np.ndarray]) -> list[RankedCause]:
    """Every cause that was fitted, by probability, then by how much it bought alone."""
    nothing = search.fits[frozenset()]
    rows = []
    for key in dict.fromkeys([*(key for keys in sorted(search.fits, key=sorted) if len(keys) == 1 for key in keys),
                              *sorted(found.causes)]):
        holders = sorted((k for k in search.fits if key in k), key=lambda k: (len(k), -search.score(search.fits[k])))
        if not holders:
            rows.append(RankedCause(key[0], key[1], found.causes.get(key, 0.0), 0.0, None, "by an equivalence"))
            continue
        fitted = search.fits[holders[0]]
        gained = (unseen_gain(search.weighing, densities[holders[0]] - densities[frozenset()])
                  if holders[0] in densities and holders[0] else None)
        bought = 2.0 * (search.evidence(fitted) - search.evidence(nothing))
        rows.append(RankedCause(key[0], key[1], found.causes.get(key, 0.0), bought, gained,
                                "" if len(holders[0]) == 1 else f"as part of {fitted.space.hypothesis.label}"))
    return sorted(rows, key=lambda r: (-round(r.probability, 6), -r.delta_chi2))


def _disturbance(predictor: Predictor, rigs: Sequence[Rig]) -> Disturbance:
    """The torque at the motor that the quickest observer needs with each rig: a share of the command's rms torque."""
    data, quickest = predictor.data, predictor.observers[:1]

    def share(rig: Rig) -> float:
        model, missing, command = build(rig, *SEARCH[:2]), 0.0, 0.0
        for r, run in enumerate(data.runs):
            torque = predict_run(data, model, quickest, r, data.own[r])[1][0]
            missing, command = missing + float(torque @ torque), command + float(run.command @ run.command)
        return float(np.sqrt(missing / max(command, 1e-300)))
    nominal, refitted, extended = predictor.pool.map(share, rigs)
    return Disturbance(nominal=nominal, refitted=refitted, extended=extended)


def _notes(rig: Rig, search: Selection, left: Remainder, said: Stated, spoken: Odds, gains: np.ndarray) -> list[str]:
    data = search.predictor.data
    notes = [f"{len(search.fits)} sets of causes fitted to {len(data.runs)} runs",
             f"noise at rest: encoder {data.noise[0]:.2f}"
             + (f", accelerometer {data.noise[1]:.2f}" if data.has_accel else "") + " counts",
             f"temperature of the likelihood: {search.weighing.temperature:.2f}; independent errors: "
             f"{search.weighing.independent.sum():.0f} of {search.predictor.counts.sum():.0f}"]
    if said.causes:
        notes.append(f"log density of runs left out, constants' included, by the causes: {gains.sum():+.1f}, standard "
                     f"error {standard_error(gains):.1f}")
    unstable = sorted(spoken.sets[0][0] - said.causes)
    if unstable:
        notes.append("in the best set but not stated, for too few resamples name them: "
                     + ", ".join(f"{n}{f' at {at}' if at else ''} ({spoken.stability.get((n, at), 0.0):.2f})"
                                 for n, at in unstable))
    if rig.beam is not None and data.rig.beam.elements != rig.beam.elements:
        notes.append(f"simulated with {data.rig.beam.elements} beam elements; with the {rig.beam.elements} of the "
                     "rig file the mesh's own error would look like physics")
    for r, run in enumerate(data.runs):
        for c, channel in enumerate(("encoder", "accel")[: data.channels]):
            if max(left.size[r, c], left.slow[r, c]) > NOISE:
                notes.append(f"{run.name}: {channel} is left with more than noise over the whole run")
    return notes
