"""Draws the demo's hidden rig: constants within their uncertainty, and one effect that shows."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from station.model.effects import Effect, catalogue
from station.model.simulate import simulate
from station.rig import Rig
from station.runs.run import Run

SHOWS = 2.0
"""Counts, rms, by which the effect must change the angle or the acceleration in the demo's tests."""
STILL_MOVES = 0.3
"""Share of its range that the arm must keep, or the effect is a broken rig."""
SIZES = (0.7, 1.4)
"""Range of the factor on the size that the catalogue suggests."""
LEFT_OUT = frozenset({"clock_scale"})
"""By the angle and the acceleration alone this one is the same as other constants (a known equivalence)."""


@dataclass(frozen=True)
class Sealed:
    """A rig file that nobody opens before the end; its hash is told at once."""

    path: Path
    sha256: str

    @classmethod
    def write(cls, rig: Rig, path: Path) -> Sealed:
        """Write the rig, readable by this user alone."""
        data = rig.to_toml().encode("utf-8")
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
        return cls(path, hashlib.sha256(data).hexdigest())

    def open(self) -> Rig:
        """Read it, after making sure that it is what was sealed."""
        data = self.path.read_bytes()
        if hashlib.sha256(data).hexdigest() != self.sha256:
            raise ValueError(f"{self.path}: not the file that was sealed")
        return Rig.from_toml(data.decode("utf-8"), source=str(self.path))


def draw(nominal: Rig, tests: list[Run], rng: np.random.Generator) -> Rig:
    """A rig whose constants lie within two sigma of the nominal's, with one effect drawn from the catalogue.

    ``tests`` are runs whose references, controllers and commands stand for the tests to come: an effect that
    does not show in them, or keeps the arm from moving, is drawn again.
    """
    places = [(cls, at) for name, cls in catalogue().items() if name not in LEFT_OUT
              for at in cls.sites if cls.fits(nominal, at)]
    while True:
        clean = _draw_constants(nominal, rng)
        kind, at = places[rng.integers(len(places))]
        effect = _draw_size(kind, at, clean, rng)
        if effect is not None and _visible(clean, clean.with_effects([effect]), tests):
            return clean.with_effects([effect])


def _draw_constants(nominal: Rig, rng: np.random.Generator) -> Rig:
    """Logarithms from the prior, each of its factors cut at two sigma."""
    paths = list(nominal.constants())
    values, vectors = np.linalg.eigh(nominal.log_covariance(paths))
    scores = rng.normal(size=len(paths))
    while np.any(far := np.abs(scores) > 2.0):
        scores[far] = rng.normal(size=int(far.sum()))
    shift = vectors @ (np.sqrt(np.maximum(values, 0.0)) * scores)
    constants = nominal.constants()
    return nominal.with_constants({path: constants[path] * float(np.exp(d))
                                   for path, d in zip(paths, shift, strict=True)})


def _draw_size(kind: type[Effect], at: str, rig: Rig, rng: np.random.Generator) -> Effect | None:
    """One of the catalogue's suggestions for this rig, each size changed by a factor; None where out of bounds."""
    guesses = kind.guesses(rig, at)
    values = dict(guesses[rng.integers(len(guesses))])
    factor = float(np.exp(rng.uniform(*np.log(SIZES))))
    for name, info in kind.parameters().items():
        if info.periodic:
            values[name] += rng.uniform(-0.5, 0.5)
        elif name == "cycles":
            continue
        elif info.neutral is not None and np.isfinite(info.neutral):
            values[name] = info.neutral + (values[name] - info.neutral) * factor
        else:
            values[name] *= factor
    try:
        return kind(at=at, **values)
    except ValueError:
        return None


def _visible(clean: Rig, hidden: Rig, tests: list[Run]) -> bool:
    """Whether the effect shows in the tests and leaves the arm moving."""
    shown = 0.0
    for run in tests:
        without, with_it = simulate(clean, run), simulate(hidden, run)
        if np.ptp(with_it.encoder) < STILL_MOVES * np.ptp(without.encoder):
            return False
        changes = [without.encoder - with_it.encoder]
        if without.accel is not None:
            changes.append(without.accel - with_it.accel)
        shown = max(shown, *(float(np.sqrt(np.mean(np.square(change)))) for change in changes))
    return shown >= SHOWS
