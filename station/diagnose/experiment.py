"""The next experiment: of the tests that the station can run, the one in which the leading rivals differ most.

The two most probable sets of causes that differ in a cause are both simulated, as fitted, in every test of TESTS.
Their distance is chi^2 = sum over channels and samples of (difference/sigma)^2, sigma from the noise at rest and
rounding (Box and Hill 1967, with both predictions taken as sharp).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from station.control.references import reference_from_test
from station.diagnose.estimate import Fit
from station.diagnose.posterior import Odds
from station.diagnose.result import NextExperiment, Verdict
from station.diagnose.search import Search
from station.model.simulate import build, simulate_model
from station.runs.run import Run, RunMetadata

P = {"kind": "p", "gain": 2.0}
LEAD = {"kind": "lead", "gain": 20.0, "zero": 31.41592653589793, "pole": 125.66370614359172}
OPEN = {"kind": "open"}
TESTS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    *(({"kind": "step", "amplitude": float(a)}, c) for c in (P, LEAD) for a in (30, 100, 200)),
    *(({"kind": "pulse", "amplitude": float(a)}, OPEN) for a in (20, 60, 150, 200)),
    ({"kind": "triangle", "amplitude": 60.0}, P),
    ({"kind": "multisine", "amplitude": 60.0, "duration": 6.0}, {"kind": "p", "gain": 1.0}),
    ({"kind": "sweep", "amplitude": 40.0, "f0": 0.3, "f1": 20.0, "duration": 10.0}, {"kind": "p", "gain": 1.0}),
]
DECIDES = 25.0
"""chi^2 from which on a test would tell two rivals apart."""


def _as_run(search: Search, test: dict[str, Any], controller: dict[str, Any]) -> Run:
    rig = search.problem.rig
    limit = rig.amplifier.limit
    reference = reference_from_test(test, rig.sample_rate)
    if controller["kind"] == "open":
        reference = np.clip(reference, -limit, limit)
    zeros = np.zeros_like(reference)
    return Run("planned", np.arange(len(reference)) * rig.period, reference, reference, zeros, zeros,
               RunMetadata(controller=controller, test=test, command_row=-1))


def distance(search: Search, one: Fit, other: Fit, test: dict[str, Any], controller: dict[str, Any]) -> float:
    """chi^2 between what two fitted hypotheses predict of a test."""
    problem = search.problem
    run = _as_run(search, test, controller)
    pair = [simulate_model(build(problem.rig_of(f.layout, f.x)), run, rounding=False) for f in (one, other)]
    total = float(np.sum((pair[0].encoder - pair[1].encoder) ** 2)) / problem.sigma[0] ** 2
    if problem.has_accel and pair[0].accel is not None and pair[1].accel is not None:
        total += float(np.sum((pair[0].accel - pair[1].accel) ** 2)) / problem.sigma[1] ** 2
    return total if np.isfinite(total) else 0.0


def next_experiment(search: Search, odds: Odds, verdict: Verdict) -> NextExperiment | None:
    """What to do next; None where nothing is open."""
    if verdict in ("explained", "nothing_missing"):
        return None
    if verdict == "not_enough_data":
        return NextExperiment(test={"kind": "step", "amplitude": 100.0, "controller": "p"},
                              why="these runs hardly move the rig: a plain cause would not have shown in them")
    best = odds.sets[0][0]
    rivals = [keys for keys, _ in odds.sets[1:] if keys != best] or [frozenset()]
    rival = rivals[0]
    names = " and ".join(_words(keys) for keys in (best, rival))
    reach = [(distance(search, search.fits[best], search.fits[rival], *pair), pair) for pair in TESTS]
    chi2, (test, controller) = max(reach, key=lambda row: row[0])
    if chi2 < DECIDES:
        return NextExperiment(test=None, why=f"{names} predict the same in every test that this station can run "
                                             f"(largest distance chi^2 = {chi2:.1f})")
    return NextExperiment(test={**test, "controller": controller},
                          why=f"{names} differ most here: chi^2 = {chi2:.0f} expected")


def _words(keys: frozenset[tuple[str, str]]) -> str:
    return " + ".join(sorted(f"{name} at {at}" if at else name for name, at in keys)) or "no cause"
