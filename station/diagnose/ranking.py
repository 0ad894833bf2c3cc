"""Every candidate and why it stands where it does, and what else the search has to say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from station.diagnose.finding import Finding
from station.diagnose.odds import Odds, is_beyond
from station.diagnose.result import CHANNELS, RankedCause
from station.diagnose.selection import Selection, log_prior
from station.diagnose.thresholds import NOISE
from station.diagnose.unseen import Unseen
from station.diagnose.validation import standard_error, unseen_gain
from station.estimation.cause import Causes, Key
from station.rig import Rig


def ranking(search: Selection, found: Odds, unseen: Unseen) -> list[RankedCause]:
    """Every cause that was fitted, by probability, then by how much it bought alone."""
    nothing, densities = search.fits[frozenset()], unseen.densities
    rows = []
    for key in dict.fromkeys([*(key for keys in sorted(search.fits, key=sorted) if len(keys) == 1 for key in keys),
                              *sorted(found.causes)]):
        holders = sorted((k for k in search.fits if key in k), key=lambda k: (len(k), -search.score(search.fits[k])))
        row = RankedCause(key[0], key[1], found.causes.get(key, 0.0), 0.0, None, "by an equivalence")
        if holders:
            keys, fitted = holders[0], search.fits[holders[0]]
            gained = (unseen_gain(search.compared, densities[keys] - densities[frozenset()])
                      if keys in densities else None)
            row = replace(row, delta_chi2=2.0 * (search.evidence(fitted) - search.evidence(nothing)),
                          held_out_gain=gained,
                          note="" if len(keys) == 1 else f"as part of {fitted.space.hypothesis.label}")
            row = _placed(search, found, unseen, row, holders)
        rows.append(row)
    return sorted(rows, key=lambda r: (-round(r.probability, 6), -r.delta_chi2))


def _placed(search: Selection, found: Odds, unseen: Unseen, row: RankedCause, holders: Sequence[Causes]) -> RankedCause:
    """A candidate with what it adds to its set, and why it is not named; ``holders``: the sets with it, smallest first.
    """
    key, said, named = (row.effect, row.at), max(unseen.densities, key=len), unseen.left_out[0].key
    tried = named | {key} if named and named | {key} in search.fits else holders[0]
    row = replace(row, adds=_added(search, tried, key), price=-2.0 * log_prior(key),
                  stability=found.stability.get(key, 0.0))
    if key in named:
        return row
    row = replace(row, beside_named=tried == named | {key} and bool(named))
    best = max((search.fits[keys] for keys in holders), key=search.score)
    reference = search.fits.get(named) or search.best()
    instead = {one for one in named if one[0] == row.effect} or (reference.key - best.key if named else frozenset())
    row = replace(row, behind=2.0 * (search.score(reference) - search.score(best)))
    if key in said:
        return replace(row, lost="left_out")
    if not is_beyond(search, best, key):
        return replace(row, lost="within")
    if key in found.sets[0][0] or row.behind < 0.0:
        return replace(row, lost="resamples")
    return replace(row, lost="another", instead=tuple(sorted(instead))) if instead else row


def _added(search: Selection, keys: Causes, key: Key) -> float | None:
    """Twice what a cause adds to the log evidence of a set without it; None where one of the two was not fitted."""
    if keys not in search.fits or keys - {key} not in search.fits:
        return None
    return 2.0 * (search.evidence(search.fits[keys]) - search.evidence(search.fits[keys - {key}]))


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
        gains = unseen.gains + unseen.relieved / len(unseen.gains)
        found.append(f"log density of runs left out, constants' included, by the causes: {gains.sum():+.1f}, standard "
                     f"error {standard_error(gains):.1f}")
    unstable = sorted(spoken.sets[0][0] - said.causes)
    if unstable:
        found.append("in the best set but not stated, for too few resamples name them: "
                     + ", ".join(f"{n}{f' at {at}' if at else ''} ({spoken.stability.get((n, at), 0.0):.2f})"
                                 for n, at in unstable))
    if rig.beam is not None and data.rig.beam.elements != rig.beam.elements:
        found.append(f"simulated with {data.rig.beam.elements} beam elements; with the {rig.beam.elements} of the "
                     "rig file the mesh's own error would look like physics")
    for r, run in enumerate(data.runs):
        for c, channel in enumerate(CHANNELS[: data.channels]):
            if max(left.size[r, c], left.slow[r, c]) > NOISE:
                found.append(f"{run.name}: {channel} is left with more than noise over the whole run")
    return found
