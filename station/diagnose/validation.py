"""What an extension buys on runs that no fit has seen: whole runs, predictions a time ahead, and step measures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from station.diagnose.measures import floor, nrmse, repeats, step_figures
from station.diagnose.result import CHANNELS, ChannelGain, Gain, RunComparison, RunGain
from station.diagnose.thresholds import EXPLAINABLE, UNSEEN, WORSE
from station.estimation.dataset import Dataset
from station.estimation.fitted import Fit
from station.estimation.least_squares import DIVERGED, STEP, correct, fit, own_steps
from station.estimation.likelihood import Weighing, block_weights, cost, nuisance_precision
from station.estimation.observer import observers
from station.estimation.prediction import Predictor, angle_that_reads, predict_run
from station.estimation.spread import between_runs
from station.model.simulate import Model, Simulation, build, simulate_model

AHEAD = (0.1, 1.0)
"""Seconds ahead that predictions are told for."""
UNKNOWN_AHEAD = 0.5
"""The same where a run's controller is unknown, so that no whole closed loop can be simulated."""
OWN_STEPS = 8
"""Most steps to what a run has of its own."""


def not_closed(data: Dataset, run: int) -> str:
    """Why a run's loop cannot be closed again, as a clause; empty where it can, or none was closed."""
    this, record = data.runs[run], data.records[run]
    if this.open_loop:
        return ""
    if this.loop_unknown:
        return "the log does not say what closed its loop"
    if record.in_motion:
        return "the log begins in motion"
    moved = np.diff(this.reference, append=this.reference[-1])[this.blank].any()
    return "the reference moved in a gap of the log" if moved else ""


def seconds_ahead(data: Dataset, run: int) -> float | None:
    """How far ahead a run is predicted where its loop cannot be closed again.  None: it is simulated as a whole."""
    return UNKNOWN_AHEAD if not_closed(data, run) else None


def whole_run(data: Dataset, model: Model, run: int, own: np.ndarray, *, rounding: bool = True,
              zero: float = 0.0, place: float = 0.0) -> Simulation:
    """One run as its test would have gone on a rig; ``own`` (4) as ``Dataset.own`` has it.

    A closed loop is simulated from its reference, or predicted ``seconds_ahead`` of what was read before; an open one
    is simulated from its command, where that is known.
    """
    this, ahead, (start, offset, share, constant) = data.runs[run], seconds_ahead(data, run), (float(v) for v in own)
    if ahead is None and not (this.open_loop and data.records[run].finding.any()):
        return simulate_model(model, this, rounding=rounding, start_angle=angle_that_reads(model.rig, start, zero),
                              accel_offset=offset, zero=zero, gap_place=place, more=(share, constant))
    watched = observers(data.rig, data.noise[0], (ahead or math.inf,))
    found = predict_run(data, model, watched, run, own, zero=zero, place=place)[0][0]
    if rounding:
        found = np.floor(found + 0.5)
    return Simulation(this.t, this.reference, this.command, found[0], found[1] if data.has_accel else None)


def settled_run(data: Dataset, model: Model, run: int, own: np.ndarray, differ: tuple[float, float] = (0.0, 0.0),
                zero: float = 0.0, place: float = 0.0) -> Simulation:
    """The same with what suits the run best of what it has of its own (two Gauss-Newton steps), as the device would
    have read it; ``differ`` as ``Weighing`` has it."""
    moves = np.isin(data.free, np.flatnonzero([True, True, *(size > 0.0 for size in differ)]))
    free, prior = data.free[moves], nuisance_precision(data, differ)[run][moves]
    scale = np.sqrt(data.records[run].share) / data.sigma[:, None]
    steps, first, own = own_steps(data), data.own[run], own.copy()

    def outputs(own: np.ndarray) -> np.ndarray:
        made = whole_run(data, model, run, own, rounding=False, zero=zero, place=place)
        return np.stack([getattr(made, c) for c in CHANNELS[: data.channels]])

    for _ in range(2):
        here = outputs(own)
        if not np.all(np.isfinite(here)):
            break
        columns = np.stack([((outputs(own + steps * (np.arange(4) == k)) - here) * scale).ravel() / steps[k]
                            for k in free])
        error = ((data.records[run].measured - here) * scale).ravel()
        with np.errstate(over="ignore", invalid="ignore"):
            step = np.linalg.solve(columns @ columns.T + np.diag(prior), columns @ error - prior * (own - first)[free])
        if not np.all(np.isfinite(step)):
            break
        own[free] += step
        own[0] = np.clip(own[0], first[0] - data.rig.angle_per_count, first[0] + data.rig.angle_per_count)
    return whole_run(data, model, run, own, zero=zero, place=place)


def nominal(data: Dataset, found: Fit) -> Fit:
    """The rig as its file says, in a fit's place: runs have of their own what was read, and do not differ otherwise."""
    return replace(found, x=np.zeros(found.space.size), own=data.own,
                   weighing=replace(found.weighing, differ=(0.0, 0.0)))


def leave_each_out(predictor: Predictor, weighing: Weighing, found: Fit, *, far: bool) -> list[Fit]:
    """For every run a fit that leaves that run out.

    Begun from the fit of all runs, since the way from the prior ends in side valleys; what the left-out run alone had
    said is lost on the way, for there the prior alone speaks.  That is ``far`` where more than noise is left.  Where in
    a gap the motor stood at the run's start, and a zero of the encoder that no other run has, are its own, as its
    starting angle is, and stay.
    """
    def without(r: int) -> Fit:
        weights = np.ones(len(predictor.data.runs))
        weights[r] = 0.0
        with suppress(*DIVERGED):
            left = fit(predictor, found.space, weighing, found.x, found.own, runs=weights,
                       jacobian=found.jacobian, iterations=12 if far else 6, renewals=4 if far else 2).light
            return replace(left, x=found.space.with_own_of(left.x, found.x, r, predictor.data.zero_groups))
        return found.light

    return list(predictor.pool.map(without, range(len(predictor.data.runs))))


def predict_unseen(predictor: Predictor, found: Fit, left_out: Sequence[Fit],
                   ) -> tuple[list[Simulation], list[dict[str, float]]]:
    """Every run by the fit that left it out (exact model): simulated as a whole (whole counts), and the encoder's nrmse
    of predictions AHEAD seconds ahead.

    What a run has of its own no other run can say: a simulation takes what suits it best, predictions what the fit of
    all runs (``found``) has it for.  In a closed loop a gain of its own hardly shows, and what suits that best need not
    suit them.
    """
    data = predictor.data
    watched = observers(data.rig, data.noise[0], AHEAD)

    def one(r: int) -> tuple[Simulation, dict[str, float]]:
        left, record = left_out[r], data.records[r]
        model, zero = build(left.space.rig_at(left.x)), left.space.zero(left.x, record.zero_group)
        place = left.space.place(left.x, r)
        made, _ = predict_run(data, model, watched, r, found.own[r], zero=zero, place=place)
        return (settled_run(data, model, r, left.own[r], left.weighing.differ, zero, place),
                {f"{seconds:g} s": nrmse(record.run.encoder[record.window], angle[record.window])
                 for seconds, angle in zip(AHEAD, made[:, 0], strict=True)})
    made, ahead = zip(*predictor.pool.map(one, range(len(data.runs))), strict=True)
    return list(made), list(ahead)


@dataclass(frozen=True, eq=False)
class Predicted:
    """What a fit that left a run out predicts of it."""

    log_density: float
    """ln of the density of the run, up to a number that all fits share."""
    errors: np.ndarray
    """(b, n) of the most likely prediction, in units of the noise."""


def predicted(predictor: Predictor, weighing: Weighing, left: Fit, run: int) -> Predicted:
    """The density that a fit, which left a run out, predicts of that run, and the errors.

    A log pointwise predictive density (Vehtari, Gelman and Gabry, Stat. Comput. 27, 2017) of a group of data with
    parameters of its own: what the run has of its own and all that the other runs leave open (``differing``) are
    integrated out, about their most likely values, by Laplace's approximation.
    """
    data, space = predictor.data, left.space
    measured, scale = predictor.measured(run), predictor.scale(run)
    counts, independent = predictor.counts[run], weighing.independent[run]
    directions = differing(left, run)
    free = len(data.free)
    steps = np.concatenate([own_steps(data)[data.free], np.full(len(directions), STEP)])
    prior = np.concatenate([left.own_precision(left.weighing.differ)[run], np.ones(len(directions))])
    first = np.concatenate([data.own[run][data.free], np.zeros(len(directions))])
    count = data.rig.angle_per_count

    def errors(moved: np.ndarray) -> np.ndarray:
        own = left.own[run].copy()
        own[data.free] = moved[:free]
        x = left.x + moved[free:] @ directions
        return (measured - predictor.some(predictor.model(space, x), space, x, [run], own[None])[0]) * scale

    def surprise(e: np.ndarray, moved: np.ndarray) -> float:
        return (cost(np.sum(e * e, axis=1), counts, independent) / weighing.temperature
                + float(prior @ (moved - first) ** 2))

    at = np.concatenate([left.own[run][data.free], np.zeros(len(directions))])
    here = errors(at)
    value = surprise(here, at)
    if not np.isfinite(value):
        return Predicted(-math.inf, here)
    columns = np.zeros((len(at), *here.shape))
    for k in range(OWN_STEPS):
        for i in range(free if k else len(at)):     # the others: by ``correct``, below
            columns[i] = (here - errors(at + steps[i] * (np.arange(len(at)) == i))) / steps[i]
        weights = block_weights(np.sum(here * here, axis=1), counts, independent) / weighing.temperature
        matrix = np.einsum("ibn,b,jbn->ij", columns, weights, columns) + np.diag(prior)
        step = np.linalg.solve(matrix, np.einsum("ibn,b,bn->i", columns, weights, here) - prior * (at - first))
        for share in (1.0, 0.3, 0.1):
            moved = at + share * step
            moved[0] = np.clip(moved[0], data.own[run, 0] - count, data.own[run, 0] + count)
            there = errors(moved)
            fell = value - surprise(there, moved)
            if fell > 0.0:
                correct(columns, moved - at, prior, here - there)
                at, here, value = moved, there, value - fell
                break
        if not fell > 0.1:
            break
    return Predicted(-0.5 * (value + float(np.linalg.slogdet(matrix)[1]) - float(np.sum(np.log(prior)))), here)


def differing(left: Fit, run: int) -> np.ndarray:
    """(p, p) along what the parameters of a run that was left out may differ from the fit of the others, one standard
    deviation each: they are known as well as those runs say, and a cause's sizes differ as much as they do there."""
    space, others = left.space, (left.owner != run).astype(float)
    effects = space.parts["effects"]
    ways = [*(space.along_log(path) for path in space.hypothesis.constants), *np.eye(space.size)[effects]]
    spread = np.array([between_runs(left, way, others).size * way for way in ways]).reshape(len(ways), space.size)
    known = left.normal(left.weighing, others)[0] + np.diag(space.precision)
    variances, along = np.linalg.eigh(np.linalg.inv(known) + spread.T @ spread)
    return (along * np.sqrt(np.maximum(variances, 0.0))).T


def all_predicted(predictor: Predictor, weighing: Weighing, left_out: Sequence[Fit]) -> list[Predicted]:
    """Every run by the fit that left it out."""
    return list(predictor.pool.map(lambda r: predicted(predictor, weighing, left_out[r], r), range(len(left_out))))


def log_densities(found: Sequence[Predicted]) -> np.ndarray:
    """(runs) ln of the density of every run."""
    return np.array([one.log_density for one in found])


def information(predictor: Predictor, weighing: Weighing, without: Sequence[Predicted], found: Sequence[Predicted],
                ) -> np.ndarray:
    """(runs) by how much causes would raise the log density of each run left out if they were right: by what they
    change in its prediction, whatever was measured.

    Half the rise of -2 ln L where the change is added to errors that have nothing to do with it.
    """
    def rise(r: int) -> float:
        counts, independent = predictor.counts[r], weighing.independent[r]
        left = np.sum(found[r].errors ** 2, axis=1)
        change = np.sum((without[r].errors - found[r].errors) ** 2, axis=1)
        return cost(left + change, counts, independent) - cost(left, counts, independent)
    with np.errstate(invalid="ignore"):     # a run that does not simulate
        return np.array([rise(r) for r in range(len(found))]) / (2.0 * weighing.temperature)


def unseen_gain(weighing: Weighing, gains: np.ndarray) -> float:
    """What causes raise the log densities of unseen runs by (runs), as a share of their errors: 1 - exp(-gain per
    independent error)."""
    independent = float(weighing.independent.sum()) / weighing.temperature
    return -math.expm1(-float(gains.sum()) / max(independent, 1e-300))


def relief(without: Sequence[Fit], found: Sequence[Fit]) -> float:
    """By how much causes raise the log prior density of the rig's constants, mean of fits that leave run after run out.

    What a rig file states of its constants was measured, too: a refit that meets the runs by straining them has not met
    all that is known.
    """
    return float(np.mean([after.log_constants - before.log_constants
                          for before, after in zip(without, found, strict=True)]))


def standard_error(gains: np.ndarray, informed: np.ndarray) -> float:
    """Of the sum of what causes raise the log densities of unseen runs by (runs), from what each run could say
    (``information``, runs).

    A run that the causes hardly change cannot gain by them, and that it does not speaks neither for nor against: gains
    are taken to be in proportion to the information, and scatter about that (the ratio estimator: Cochran, Sampling
    Techniques, 3rd ed. 1977, section 6.4).  A log likelihood ratio itself has twice its mean for a variance, where the
    causes are right; that is the least.
    """
    with np.errstate(invalid="ignore", divide="ignore"):     # a run that does not simulate
        total = float(informed.sum())
        apart = gains - (gains.sum() / total if total > 0.0 else 0.0) * informed
        return math.sqrt(max(float(apart @ apart) * len(gains) / (len(gains) - 1), 2.0 * total))


def contradicted(gains: np.ndarray, informed: np.ndarray, relieved: float) -> bool:
    """Whether unseen runs (gains, and what each could say, runs), with what the rig file states of its constants, speak
    against causes: together they are not met better than by a refit alone by UNSEEN standard errors."""
    allowed = UNSEEN * standard_error(gains, informed)
    return not float(gains.sum()) + relieved >= allowed     # what is no number does not help


def missed_by_more(data: Dataset, before: Sequence[Simulation], refit: Sequence[Simulation],
                   after: Sequence[Simulation]) -> bool:
    """Whether simulations miss the angles of the runs by more, by the geometric mean over runs, than those before did,
    or than the re-fitted rig's do beyond what differs from run to run (Student's test of pairs, WORSE): a rig
    that goes further astray is no better, however well it predicts a little ahead.

    As errors of unknown size are counted (``likelihood.rho``): by the logarithm of their mean square, in units of the
    noise.  In a sum of squares one run that asks more of the model than the others could tell decides alone.
    """
    def log_squares(made: Sequence[Simulation]) -> np.ndarray:
        errors = [(record.measured[0] - one.encoder)[record.window]
                  for record, one in zip(data.records, made, strict=True)]
        return np.array([math.log1p(float(np.mean(np.square(e))) / data.sigma[0] ** 2) for e in errors if e.size])
    old, middle, new = map(log_squares, (before, refit, after))
    if not new.sum() <= old.sum():      # what is no number is no better
        return True
    more, runs = new - middle, len(new)
    return runs > 1 and bool(np.mean(more) > stdtrit(runs - 1, WORSE) * np.std(more, ddof=1) / math.sqrt(runs))


def _loops_step(c: RunComparison, made: Simulation) -> dict[str, float | None]:
    """Step figures of a simulation; what is predicted a time ahead is no loop's answer to a step."""
    return step_figures(c.run, made.encoder, c.part) if c.seconds_ahead is None else {}


def gain(data: Dataset, comparisons: Sequence[RunComparison],
         ahead: tuple[Sequence[dict[str, float]], Sequence[dict[str, float]]]) -> Gain:
    """The diagnosis file's gain: nrmse over all held-out runs and the share of the explainable error removed.

    ``ahead``: per run the errors of predictions so far ahead, before and after (``predict_unseen``).
    """
    found, fractions, runs = {}, [], []
    for c, old, new, between in zip(comparisons, *ahead, repeats(data.runs), strict=True):
        runs.append(RunGain(run=c.run.name, seconds_ahead=c.seconds_ahead, repeats=between,
                            measured=step_figures(c.run, c.run.encoder, c.part),
                            before=_loops_step(c, c.before), after=_loops_step(c, c.after or c.refit),
                            ahead={time: ChannelGain(nrmse_before=old[time], nrmse_after=new[time])
                                   for time in old if np.isfinite([old[time], new[time]]).all()}))
    for channel, sigma in zip(CHANNELS[: data.channels], data.noise, strict=False):
        spread = error_before = error_after = explained = explainable = 0.0
        for one, c in zip(runs, comparisons, strict=True):
            size = c.variance(channel)
            if size == 0.0:
                continue
            measured = getattr(c.run, channel)[c.rows]
            least = floor(measured, sigma, c.run.step(channel))
            b, a = (nrmse(measured, getattr(made, channel)[c.rows]) for made in (c.before, c.after or c.refit))
            setattr(one, channel, ChannelGain(nrmse_before=b, nrmse_after=a))
            spread += size
            error_before += b * b * size
            error_after += a * a * size
            if b > EXPLAINABLE * least:
                explained += b - a
                explainable += b - least
        if spread:
            found[channel] = ChannelGain(nrmse_before=float(np.sqrt(error_before / spread)),
                                         nrmse_after=float(np.sqrt(error_after / spread)))
        if explainable:
            fractions.append(explained / explainable)
    return Gain(held_out=[one.run for one in runs], encoder=found.get("encoder"), accel=found.get("accel"), runs=runs,
                explained_fraction=float(np.mean(fractions)) if fractions else None)
