"""From fits to odds: probabilities over sets of causes, intervals, and whether what remains is noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from station.diagnose.estimate import Fit
from station.diagnose.result import Estimate
from station.diagnose.search import Search
from station.diagnose.states import layout_states

Key = tuple[str, str]
UNITS = {"motor.inertia": "kg m^2", "motor.damping": "N m s/rad", "motor.gain": "N m/count",
         "drive.stiffness": "N m/rad", "drive.damping": "N m s/rad", "base.inertia": "kg m^2",
         "clamp.stiffness": "N m/rad", "clamp.damping": "N m s/rad", "beam.mass_per_length": "kg/m",
         "beam.length": "m", "beam.flexural_rigidity": "N m^2", "beam.damping": "s", "tip.mass": "kg",
         "tip.inertia": "kg m^2", "accelerometer.gain": "counts s^2/m"}


@dataclass(frozen=True)
class Odds:
    """Posterior over the sets of causes that the search has fitted."""

    sets: list[tuple[frozenset[Key], float]]
    """(causes, probability), the best first before any doubt."""
    causes: dict[Key, float]
    nothing: float

    def doubted(self, explained: float) -> Odds:
        """The same where more is left than noise; ``explained``: the share of the error that the named causes take off.

        Something that no hypothesis holds is then at work, too, and a known cause may stand in for it; nothing in the
        data says which.  Of what the causes explain, their own part may be anything from nothing to all: half of it is
        theirs on average, so every set of causes keeps half that share of its probability.
        """
        trust = 0.5 * min(max(explained, 0.0), 1.0)
        sets = [(keys, trust * p if keys else p) for keys, p in self.sets]
        return Odds(sets, {key: trust * p for key, p in self.causes.items()}, self.nothing)

    def replacements(self, best: frozenset[Key], cause: Key) -> dict[Key, float]:
        """Probability of each other cause in sets that lack this one."""
        found: dict[Key, float] = {}
        for keys, probability in self.sets:
            if cause not in keys:
                for key in keys - best:
                    found[key] = found.get(key, 0.0) + probability
        return found


def odds(search: Search) -> Odds:
    """Normalise the scores of all fits that no run refutes; a constant within 3 sigma of nominal is not a cause."""
    temperature = search.temperature()
    rows = [(keys, search.score(found, temperature)) for keys, found in search.fits.items()
            if keys not in search.refuted and all(is_beyond(search, found, k) for k in keys)]
    return normalised(dict(rows))


def normalised(scores: dict[frozenset[Key], float]) -> Odds:
    """Odds from the log weight of every set."""
    top = max(scores.values())
    weights = [(keys, math.exp(max(score - top, -700.0))) for keys, score in scores.items()]
    total = sum(w for _, w in weights)
    sets = sorted(((keys, w / total) for keys, w in weights), key=lambda row: -row[1])
    causes: dict[Key, float] = {}
    for keys, probability in sets:
        for key in keys:
            causes[key] = causes.get(key, 0.0) + probability
    nothing = sum(p for keys, p in sets if not keys)
    return Odds(sets, causes, nothing)


def deviation(found: Fit, rig_sigma: dict[str, float], covariance: np.ndarray, path: str) -> float:
    """How far a constant is from nominal, in its own sigma, given what the others say of a common factor."""
    i = found.layout.paths.index(path)
    shared = [j for j in range(len(found.layout.paths)) if j != i and covariance[i, j] != 0.0]
    expected, variance = 0.0, covariance[i, i]
    if shared:
        gain = np.linalg.solve(covariance[np.ix_(shared, shared)], covariance[shared, i])
        expected = float(gain @ found.logs[shared])
        variance -= float(gain @ covariance[shared, i])
    return abs(float(found.logs[i]) - expected) / math.sqrt(max(variance, rig_sigma[path] ** 2))


def is_beyond(search: Search, found: Fit, key: Key, sigmas: float = 3.0) -> bool:
    """Whether a cause may be accused: any effect, and a constant beyond 3 of its own sigma."""
    if not key[0].startswith("parameter:"):
        return True
    rig, path = search.problem.rig, key[0].split(":", 1)[1]
    paths = search.problem.paths
    return deviation(found, {p: rig.sigma(p) for p in paths}, rig.log_covariance(paths), path) > sigmas


def estimates(search: Search, found: Fit, rougher: Fit | None = None,
              ) -> tuple[dict[Key, dict[str, Estimate]], dict[str, Estimate]]:
    """Fitted parameters of each cause, and the rig's constants, with 95 % intervals.

    ``rougher``: the same set fitted with coarser simulations; how far it lies from ``found`` is what the simulation's
    own steps leave uncertain, and is added to the variance.
    """
    temperature, layout = search.temperature(), found.layout
    covariance = found.covariance(temperature)
    shift = np.zeros(layout.size) if rougher is None else found.x - rougher.x
    deviations = np.sqrt(np.diag(covariance) + shift**2)
    found_states = layout_states(layout, covariance, found.x)
    n = len(layout.paths)
    nominal = search.problem.rig.constants()
    log_sd = np.sqrt(np.diag(layout.root @ covariance[:n, :n] @ layout.root.T) + (layout.root @ shift[:n]) ** 2)
    constants = {}
    for i, path in enumerate(layout.paths):
        value, spread = nominal[path] * math.exp(found.logs[i]), math.exp(1.96 * log_sd[i])
        ends = sorted((value / spread, value * spread))
        constants[path] = Estimate(value=value, low=ends[0], high=ends[1], unit=UNITS[path],
                                   state=found_states[i].state)
    causes: dict[Key, dict[str, Estimate]] = {}
    for i, coordinate in enumerate(layout.coordinates):
        k = n + i
        cls, at = layout.hypothesis.effects[coordinate.effect]
        low, value, high = (found.x[k] + s * 1.96 * deviations[k] for s in (-1.0, 0.0, 1.0))
        ends = (coordinate.to_value(low), coordinate.to_value(value), coordinate.to_value(high))
        if coordinate.info.periodic and (high - low) * coordinate.scale >= 2.0 * math.pi:
            ends = (-math.pi, ends[1], math.pi)
        causes.setdefault((cls.name, at), {})[coordinate.name] = Estimate(
            value=float(ends[1]), low=float(ends[0]), high=float(ends[2]), unit=coordinate.info.unit,
            state=found_states[k].state)
    for path in layout.hypothesis.constants:
        causes[(f"parameter:{path}", "")] = {"value": constants[path]}
    return causes, constants
