"""What an extension buys on runs that no fit has seen: the measures of whole runs and of predictions a time ahead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from station.diagnose.measures import floor, nrmse, repeats, step_figures
from station.diagnose.result import CHANNELS, ChannelGain, Gain, RunComparison, RunGain
from station.diagnose.thresholds import EXPLAINABLE, WORSE
from station.diagnose.whole_run import settled_run
from station.estimation.dataset import Dataset
from station.estimation.fitted import Fit
from station.estimation.least_squares import DIVERGED, fit
from station.estimation.likelihood import Weighing
from station.estimation.observer import observers
from station.estimation.prediction import Predictor, predict_run
from station.model.simulate import Simulation, build

AHEAD = (0.1, 1.0)
"""Seconds ahead that predictions are told for."""


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
