"""Every cause that a diagnosis considers on a rig: effects at their places and the rig's own constants."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from station.estimation.cause import Key
from station.estimation.dataset import Dataset
from station.estimation.fitted import Fit
from station.estimation.parameters import Hypothesis, Parameters, held_within, parameters
from station.model.effects import USUAL_SPEED, Effect, Stage, catalogue
from station.rig import PROFILE, Rig

INPUT, ENCODER = ("input_delay", "amplifier"), ("encoder_delay", "encoder")
ACCEL = ("accelerometer_delay", "accelerometer")
OF_A_GAP, PER_START, MOST_STARTS = 3, 5, 4
"""Guesses from which fits of a gap begin; of other effects one more for so many guesses, up to so many."""


@dataclass(frozen=True)
class Candidate:
    """One possible cause and the sizes from which a fit may start."""

    effect: type[Effect] | None
    at: str
    constant: str | None = None
    guesses: tuple[dict[str, float], ...] = ()
    by_torque: bool = False
    """Whether the guesses are read off the torque that is missing."""

    @property
    def key(self) -> Key:
        """As the diagnosis file names it."""
        return self.hypothesis.causes[0]

    @property
    def starts(self) -> int:
        """Guesses from which fits begin: more where the objective has many valleys (angles, gaps)."""
        if self.is_gap:
            return OF_A_GAP
        return min(1 + len(self.components) // PER_START, MOST_STARTS)

    @property
    def is_gap(self) -> bool:
        """Whether it is a play between two parts."""
        return self.effect is not None and self.effect.stage is Stage.GAP

    @property
    def components(self) -> list[tuple[dict[str, float], ...]]:
        """The guesses to look at: of a law with a phase, in which it is a sine, those that differ in nothing else are
        one, seen in two phases a quarter of a turn apart."""
        phase = self.phase
        if phase is None:
            return [(guess,) for guess in self.guesses]
        first = {tuple(v for name, v in guess.items() if name != phase): guess for guess in reversed(self.guesses)}
        return [(guess, {**guess, phase: math.remainder(guess[phase] + 0.25 * math.tau, math.tau)})
                for guess in reversed(first.values())]

    @property
    def phase(self) -> str | None:
        """The effect's parameter that is one, if it has such."""
        if self.effect is None:
            return None
        return next((name for name, info in self.effect.parameters().items() if info.periodic), None)

    @property
    def hypothesis(self) -> Hypothesis:
        """This cause alone."""
        return Hypothesis((), (self.constant,)) if self.effect is None else Hypothesis(((self.effect, self.at),))

    def alike(self, other: Candidate) -> bool:
        """Whether the two are one cause, or one law a special case of the other's at the same place."""
        return self.key == other.key or self.hypothesis.holds(other.key) or other.hypothesis.holds(self.key)

    def repeating(self, waves: Sequence[float]) -> Candidate:
        """The same, guessed to repeat itself so often per turn, as far as its law may."""
        name = self.effect.waves
        known, guess = self.effect.parameters()[name], self.guesses[0]
        return replace(self, by_torque=True,
                       guesses=tuple(guess | {name: n} for n in waves if known.low <= n <= known.high))

    def sized(self, guess: dict[str, float], factor: float) -> dict[str, float]:
        """A guess so many times as large; a constant has none."""
        return guess if self.effect is None else self.effect.sized(guess, factor)

    def beside(self, data: Dataset, fit: Fit, guess: dict[str, float]) -> tuple[Parameters, np.ndarray]:
        """The parameters of a fit's hypothesis with this cause at a guess beside it, and where in them it begins."""
        base = fit.space
        space = parameters(data, base.hypothesis + self.hypothesis, {**base.values(base.mean), self.key: guess})
        return space, space.carried(base, fit.x, {self.key: guess})


def candidates(rig: Rig, speed: float = USUAL_SPEED) -> list[Candidate]:
    """All causes for this rig; what its file already holds is part of it and no cause.  ``speed``: of its runs, rad/s.

    Without a drive motor and base are one part: an effect that may stand at either is one cause, at the motor.  A
    constant that the file calls exact (uncertainty 0) is none.  What the file states of an effect within an uncertainty
    is one as a constant is, where that effect stands once.
    """
    held = {(e.name, e.at) for e in rig.effects}
    found = []
    for cls in catalogue().values():
        for at in cls.sites:
            if at == "base" and rig.drive is None and "motor" in cls.sites:
                continue
            if cls.fits(rig, at) and (cls.name, at) not in held:
                found.append(Candidate(cls, at, None, tuple(cls.guesses_at(rig, at, speed))))
    paths = list(rig.constants())
    exact = {path for path, variance in zip(paths, rig.log_covariance(paths).diagonal(), strict=True) if not variance}
    names = [effect.name for effect in rig.effects]
    stated = [one.path for one in held_within(rig) if names.count(rig.effects[one.effect].name) == 1]
    return found + [Candidate(None, "", path) for path in [*(p for p in paths if p not in PROFILE | exact), *stated]]


def one_too_many(rig: Rig, causes: Collection[Key]) -> bool:
    """Whether a set holds a delay more than its signals show: of one before the motor and one behind each sensor only
    the sums show (``docs/equivalences.md``), so that one can always be traded away."""
    return {INPUT, ENCODER, ACCEL} - ({ACCEL} if rig.accelerometer is None else set()) <= set(causes)
