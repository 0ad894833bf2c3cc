"""Every candidate and why it stands where it does, and what else the search has to say."""

from __future__ import annotations

from station.diagnose.finding import Finding
from station.diagnose.odds import Odds
from station.diagnose.result import CHANNELS, RankedCause
from station.diagnose.selection import Selection
from station.diagnose.thresholds import NOISE
from station.diagnose.unseen import Unseen
from station.diagnose.validation import standard_error, unseen_gain
from station.rig import Rig


def ranking(search: Selection, found: Odds, unseen: Unseen) -> list[RankedCause]:
    """Every cause that was fitted, by probability, then by how much it bought alone."""
    nothing, densities = search.fits[frozenset()], unseen.densities
    rows = []
    for key in dict.fromkeys([*(key for keys in sorted(search.fits, key=sorted) if len(keys) == 1 for key in keys),
                              *sorted(found.causes)]):
        holders = sorted((k for k in search.fits if key in k), key=lambda k: (len(k), -search.score(search.fits[k])))
        if not holders:
            rows.append(RankedCause(key[0], key[1], found.causes.get(key, 0.0), 0.0, None, "by an equivalence"))
            continue
        keys, fitted = holders[0], search.fits[holders[0]]
        gained = (unseen_gain(search.compared, densities[keys] - densities[frozenset()]) if keys in densities else None)
        bought = 2.0 * (search.evidence(fitted) - search.evidence(nothing))
        rows.append(RankedCause(key[0], key[1], found.causes.get(key, 0.0), bought, gained,
                                "" if len(keys) == 1 else f"as part of {fitted.space.hypothesis.label}"))
    return sorted(rows, key=lambda r: (-round(r.probability, 6), -r.delta_chi2))


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
