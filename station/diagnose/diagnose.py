"""The diagnosis: what the simulation gets wrong, why, and what the better rig buys on unseen runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from station.diagnose import PREPARE
from station.diagnose.disturbance import disturbance
from station.diagnose.effort import EFFORTS
from station.diagnose.equivalences import Setting, completed, exact_sizes, rivals, standing, with_word
from station.diagnose.estimates import estimates, rig_of, with_sizes
from station.diagnose.experiment import choose
from station.diagnose.finding import between_runs, bought, find
from station.diagnose.logs import as_logged
from station.diagnose.odds import Odds, in_order, with_outside
from station.diagnose.ranking import in_file, notes, ranking
from station.diagnose.result import (
    Cause,
    Choice,
    Diagnosis,
    DiagnosisResult,
    RunComparison,
    RunFile,
    Verdict,
)
from station.diagnose.search import select
from station.diagnose.selection import Selection
from station.diagnose.thresholds import FEW
from station.diagnose.unseen import sized, unseen
from station.diagnose.validation import gain, nominal
from station.diagnose.verdict import verdict
from station.diagnose.whole_run import not_closed, seconds_ahead
from station.diagnose.wrong import wrong
from station.errors import UsageError, WorkError
from station.estimation.answers import answers, refuse_wrong_signs_and_units, unlikely
from station.estimation.cause import Key, is_constant
from station.estimation.dataset import by_content, dataset
from station.estimation.least_squares import CANNOT_SIMULATE, DIVERGED
from station.estimation.loaded import load_compiled as load_compiled  # what PREPARE names
from station.estimation.observer import observers
from station.estimation.pool import SIZE, Pool
from station.estimation.prediction import Predictor
from station.model.effects import effect_class
from station.rig import Rig
from station.runs.run import Run

if TYPE_CHECKING:
    from station.pictures.picture import Evidence


def diagnose(rig: Rig, runs: Sequence[Run], effort: str = "full",
             progress: Callable[[str, float], None] | None = None, threads: int = SIZE) -> DiagnosisResult:
    """Diagnose a rig from its runs, by so many ``threads``, each but the first with a process of its own.

    The same runs give the same answer, whatever their order, the number of threads or the linear algebra's: runs are
    taken in the order of their content and told in that of their names, and linear algebra by one thread.  UsageError
    for an unknown effort; WorkError where the runs cannot be used (rate, columns), or not be simulated.
    """
    begun = time.perf_counter()
    if effort not in EFFORTS:
        raise UsageError(f"--effort: {effort!r} is none of {', '.join(EFFORTS)}")
    pool = Pool(threads, PREPARE)
    with threadpool_limits(1):
        found = _diagnose(rig, by_content(runs), effort, progress or (lambda text, share: None), pool)
    _put_in_order(found)
    return replace(found, seconds=time.perf_counter() - begun)


def _diagnose(rig: Rig, given: Sequence[Run], effort: str, report: Callable[[str, float], None],
              pool: Pool) -> DiagnosisResult:
    runs, parts, amiss = _usable(rig, given)
    data = dataset(rig, runs, parts)
    predictor = Predictor(data, observers(data.rig, data.noise[0]), pool, *EFFORTS[effort].accuracies)
    answered = answers(predictor)
    refuse_wrong_signs_and_units(answered)
    try:
        search = select(predictor, EFFORTS[effort], report)
    except DIVERGED:
        raise WorkError(f"{rig.name}: {CANNOT_SIMULATE}") from None
    report("drawing the data again", 0.88)
    finding = find(search)
    report("judging on runs left out", 0.92)
    finding, without_each = sized(search, finding)
    judged = unseen(search, finding, without_each)
    said, best, nothing = finding.said, finding.fit, search.fits[frozenset()]
    setting = Setting(data.rig, data.clock is not None, tuple(one.start for one in data.records if one.released))
    known = standing(setting, said.causes, best.space.rig_at(best.x))
    told = completed(finding.odds, said.causes, known)
    decision = verdict(said, told, search.screened, finding.left.is_noise, judged.against, known)
    order: list[Key] = []
    if decision in ("explained", "partly_explained", "ambiguous"):
        spoken = finding.by_law.causes
        laws = {key: spoken[key] for key in said.causes if spoken[key] != finding.odds.causes.get(key)}
        order, told = in_order(replace(told, causes={**told.causes, **laws}), said.causes,
                               partial(bought, search), finding.odds.draws.error)
    told = told if finding.left.is_noise else with_outside(told)
    shown, rough = (nothing, nothing) if said.causes and not order else (best, finding.rough)
    values, constants = estimates(search.known(shown), rough, judged.left_out)
    causes = [Cause(effect=key[0], at=key[1], probability=told.causes[key], parameters=values[key],
                    stability=finding.by_law.stability.get(key, 0.0),
                    rivals=rivals(told, said.causes, key, known)) for key in order]
    refit_rig, extended = rig_of(nothing), with_sizes(rig_of(shown), values)
    comparisons = [RunComparison(run, before, refit, after if causes else None, seconds_ahead(data, k), part,
                                 data.records[k].window, shown.space.zero(shown.x, data.records[k].zero_group),
                                 not_closed(data, k))
                   for k, (run, before, refit, after, part) in enumerate(
                       zip(runs, *judged.simulations, parts, strict=True))]
    acting = predictor.on(replace(data, rig=data.rig.with_effects(extended.effects)))
    amiss += [*unlikely(answered, answers(acting) if causes else ()), *exact_sizes(rig, order)]
    report("choosing the next experiment", 0.96)
    choice = cache(partial(_chosen, search, finding.odds, decision))
    decided = decision in ("explained", "nothing_missing") and len(given) >= FEW
    ranked = ranking(search, told, finding, judged)
    alike = [words for name, _ in order if not is_constant(name) and (words := effect_class(name).alike)]
    diagnosis = Diagnosis(
        verdict=decision, wrong=wrong(comparisons, data.noise), causes=causes,
        gain=gain(data, comparisons, judged.ahead),
        next_experiment=with_word(None if decided else choice().next, decision, told, said.causes, known),
        outside=finding.outside,
        disturbance=disturbance(predictor, [nominal(data, nothing), nothing, shown]),
        between_runs=between_runs(search, finding), rig=rig.name, effort=effort,
        runs=[RunFile(run=run.name) for run in given],
        ranking=[in_file(row) for row in ranked])
    drawn = [row.zeroed(rig.angle_per_count)
             for row, record in zip(comparisons, data.records, strict=True) if not record.finding.any()]
    drawn = [replace(run, name=given[0].name) for run in drawn[:1]] if len(given) == 1 else drawn
    draw = partial(_drawn, refit_rig, extended, drawn, [(c.effect, c.at) for c in causes], pool)
    report("done", 1.0)
    return DiagnosisResult(diagnosis, rig, refit_rig, extended, comparisons, ranked, draw, constants,
                           notes(rig, search, finding, judged), choose=choice,
                           equivalences=[*(row.equivalence.sentence for row in known), *alike] if causes else [],
                           amiss=amiss)


def _chosen(search: Selection, odds: Odds, decision: Verdict) -> Choice:
    with threadpool_limits(1):
        return choose(search, odds, decision)


def _drawn(rig: Rig, extended: Rig, runs: Sequence[Run], causes: Sequence[tuple[str, str]], pool: Pool,
           ) -> list[Evidence]:
    from station.pictures.evidence import evidence  # slow to import, and not always wanted

    with threadpool_limits(1):
        return evidence(rig, extended, runs, causes, pool) if runs else []


def _put_in_order(found: DiagnosisResult) -> None:
    """Put all that is said run by run in the order of the runs' names."""
    said = found.diagnosis
    rows: list[Any]
    for rows in (said.runs, said.gain.runs, said.between_runs.runs):
        rows.sort(key=lambda row: row.run)
    said.gain.held_out.sort()
    found.comparisons.sort(key=lambda row: row.run.name)


def _usable(rig: Rig, runs: Sequence[Run]) -> tuple[list[Run], list[slice], list[str]]:
    """The runs, checked, their gaps filled, the rows of each that count (a run that is alone is judged half by half),
    and what is amiss with them."""
    if not runs:
        raise UsageError("diagnose: at least one run is wanted")
    for run in runs:
        if rig.accelerometer is not None and run.accel is None:
            raise WorkError(f"{run.name}: no accelerometer column, but rig {rig.name} has an accelerometer")
    runs, amiss = as_logged(rig, [run.filled(rig.sample_rate) for run in runs])
    if len(runs) > 1:
        return runs, [slice(None)] * len(runs), amiss
    half = len(runs[0].t) // 2
    return ([replace(runs[0], name=f"{runs[0].name} ({part} half)") for part in ("first", "second")],
            [slice(0, half), slice(half, None)], amiss)
