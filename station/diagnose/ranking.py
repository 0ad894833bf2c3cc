"""Every candidate and why it stands where it does, and what else the search has to say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.diagnose.densities import standard_error, unseen_gain
from station.diagnose.finding import Finding
from station.diagnose.odds import Odds, may_be_accused
from station.diagnose.result import CHANNELS, NOT_NAMED, Ranked, RankedCause, Reason
from station.diagnose.screening import BIAS
from station.diagnose.selection import Selection, log_prior
from station.diagnose.thresholds import AS_GOOD, BETTER, LIKELY, NOISE, VARIES
from station.diagnose.unseen import Unseen
from station.estimation.cause import Causes, Key, in_words, is_constant
from station.estimation.identifiability import NORMAL
from station.estimation.spread import shared
from station.rig import Rig


def ranking(search: Selection, found: Odds, finding: Finding, unseen: Unseen) -> list[RankedCause]:
    """Every cause that was fitted, by probability, then by how much it bought alone."""
    alone = [key for keys in sorted(search.fits, key=sorted) if len(keys) == 1 for key in keys]
    rows = [_row(search, found, unseen, key) for key in dict.fromkeys([*alone, *sorted(found.causes)])]
    rows.sort(key=lambda row: (-round(row.probability, 6), -row.delta_chi2))
    return [replace(row, reason=_reason(search, found, finding, unseen, row, rows[0])) for row in rows]


def in_file(row: RankedCause) -> Ranked:
    """A candidate as the diagnosis file has it; of one that may add enough and is not named it says why."""
    note = row.note or {**NOT_NAMED, "resamples": "too few resamples name it"}.get(row.reason.kind, "")
    return Ranked(effect=row.effect, at=row.at, probability=row.probability, note=note)


def _row(search: Selection, found: Odds, unseen: Unseen, key: Key) -> RankedCause:
    """A candidate with what the smallest set with it buys; why it stands where it does hangs on the others."""
    keys, densities = _smallest(search, key), unseen.densities
    gained = unseen_gain(search.compared, densities[keys] - densities[frozenset()]) if keys in densities else None
    note = ("by an equivalence" if keys not in search.fits else "" if len(keys) == 1 else
            f"as part of {search.fits[keys].space.hypothesis.label}")
    return RankedCause(*key, found.causes.get(key, 0.0), _bought(search, keys, frozenset()) or 0.0, gained, note,
                       found.stability.get(key, 0.0))


def _reason(search: Selection, found: Odds, finding: Finding, unseen: Unseen, row: RankedCause, first: RankedCause,
            ) -> Reason:
    """Why a candidate stands where it does; ``first``: the one that leads."""
    key, named = (row.effect, row.at), unseen.left_out[0].key
    keys, tried = _smallest(search, key), row.note
    if named and named | {key} in search.fits:
        keys, tried = named | {key}, "beside the causes named"
    adds, price, less = _bought(search, keys, keys - {key}), -2.0 * log_prior(key), first.delta_chi2 - row.delta_chi2
    if key in named:
        return Reason("named", adds=adds if len(named) > 1 else None)
    lost = _lost(search, found, finding, unseen, key)
    if not lost and row is first:
        return Reason("leads")
    if not lost and row.probability > LIKELY:
        return Reason("likely")
    little = Reason("too_little", price, adds=adds) if adds is not None and adds < price else None
    if tried:
        return replace(little or lost or Reason("open"), tried=tried, adds=adds)
    if lost and (len(lost.instead) < 2 or first.note):
        return lost
    if less > BETTER and not first.note:
        return Reason("explains_less", less)
    return little or Reason("as_good" if row.probability > AS_GOOD else "no_better")


def _lost(search: Selection, found: Odds, finding: Finding, unseen: Unseen, key: Key) -> Reason | None:
    """Why a cause is not named though it may add enough; None where nothing says."""
    named, holders = unseen.left_out[0].key, [fit for keys, fit in search.fits.items() if key in keys]
    if not holders:
        return None
    best = max(holders, key=search.score)
    if key in max(unseen.densities, key=len):
        return Reason("left_out")
    if key in finding.may_be_none:
        return Reason("may_be_none")
    if not may_be_accused(best, key):
        return Reason("within" if is_constant(key[0]) else "too_large")
    behind = 2.0 * (search.score(search.fits[named]) - search.score(best))
    if key in found.sets[0][0] or behind < 0.0:
        return Reason("resamples", found.stability.get(key, 0.0))
    instead = {one for one in named if one[0] == key[0]} or named - best.key
    return Reason("beaten" if behind > BETTER else "matched", instead=tuple(sorted(instead))) if instead else None


def _smallest(search: Selection, key: Key) -> Causes:
    """The smallest set with a cause, of several the best; the cause alone where none was fitted."""
    return min((keys for keys in search.fits if key in keys), default=frozenset([key]),
               key=lambda keys: (len(keys), -search.score(search.fits[keys])))


def _bought(search: Selection, keys: Causes, without: Causes) -> float | None:
    """Twice what a set adds to the log evidence of one with less; None where one of the two was not fitted."""
    if not {keys, without} <= search.fits.keys():
        return None
    return 2.0 * (search.evidence(search.fits[keys]) - search.evidence(search.fits[without]))


def notes(rig: Rig, search: Selection, finding: Finding, unseen: Unseen) -> list[str]:
    """What was done and what is left, a sentence each."""
    data, said, spoken, left = search.predictor.data, finding.said, finding.by_law, finding.left
    weighing = search.compared
    found = [f"{len(search.fits)} sets of causes fitted to {len(data.runs)} runs",
             f"noise: encoder {data.noise[0]:.2f}"
             + (f", accelerometer {data.noise[1]:.2f}" if data.has_accel else "") + " counts",
             f"temperature of the likelihood: {weighing.temperature:.2f}; independent errors: "
             f"{weighing.independent.sum():.0f} of {search.predictor.counts.sum():.0f}"]
    if said.causes:
        gained, error = unseen.gains.sum() + unseen.relieved, standard_error(unseen.gains, unseen.informed)
        found.append(f"log density of runs left out, constants' included, by the causes: {gained:+.1f}, standard error "
                     f"{error:.1f}")
    if finding.may_be_none:
        found.append("in the best set but not stated, for their own 95 % intervals hold that they are not there: "
                     + ", ".join(map(in_words, sorted(finding.may_be_none))))
    unstable = sorted(spoken.sets[0][0] - said.causes - finding.may_be_none)
    if unstable:
        found.append("in the best set but not stated, for too few resamples name them: "
                     + ", ".join(f"{in_words(key)} ({spoken.stability.get(key, 0.0):.2f})" for key in unstable))
    fit = finding.fit
    constants = fit.own[:, 3]
    if not fit.alone and BIAS not in said.causes and VARIES < shared(constants) < np.inf:
        found.append(f"all runs share a constant of {constants.mean():.3g} counts of command ({constants.min():.3g} to "
                     f"{constants.max():.3g}), as a command bias does, and none is stated")
    if fit.space.back_emf:
        sigma = np.sqrt(np.diag(fit.covariance))
        low, share, high = (100.0 * fit.space.back_emf_share(fit.x + z * sigma) for z in (-NORMAL, 0.0, NORMAL))
        found.append(f"of motor.damping {share:.0f} % ({low:.0f} to {high:.0f} %) is back-EMF, which loads no gear")
    if rig.beam is not None and data.rig.beam.elements != rig.beam.elements:
        found.append(f"simulated with {data.rig.beam.elements} beam elements; with the {rig.beam.elements} of the "
                     "rig file the mesh's own error would look like physics")
    for r, run in enumerate(data.runs):
        for c, channel in enumerate(CHANNELS[: data.channels]):
            if max(left.size[r, c], left.slow[r, c]) > NOISE:
                found.append(f"{run.name}: {channel} is left with more than noise over the whole run")
    return found
