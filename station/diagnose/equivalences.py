"""Known equivalences: sets of causes that do exactly the same to every signal that a rig gives.

No test of the station can tell the two sides of one apart, so a diagnosis that names one side is `ambiguous`, whatever
the odds, and the other side's causes are its rivals.  TABLE holds all that are known, ``docs/equivalences.md`` the
proof of each; ``sides`` gives the other sides as rigs, so that the proof can be tried on the model.

**Units.**  A run holds command and encoder in counts (angles), the accelerometer in counts, and time in samples.  No
torque, length or second stands in it.  So a change of the unit of torque, of length, or (where no second clock watched
the board's) of time changes the rig's numbers and no reading.  A constant or an effect's parameter of the dimension
torque^p length^q time^r takes the factor a^p b^q c^r.

**When a wrong constant is one side.**  The unit of torque enters the data through motor.gain alone: that it is off
cannot be told from one wrong unit in every other torque, inertia, damping and stiffness, so it is always one side.
For any other constant the move along a unit must buy a believable other reading of the same data: a set of no more
causes that is at least BELIEVABLE times as probable beforehand, that would not be so without the move, and that needs
each of its causes.  With v the logarithms of the constants over nominal, S their prior covariance (a set's own
constants set free), and y what is left of v without the directions of the units,

    ln odds = LOG_PRIOR (other causes - causes) + ln N(y; 0, S_other) - ln N(y; 0, S).

What the uncertainties alone could undo accuses nobody anyway: the re-fitted rig without the cause is then as good.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
import scipy.linalg
from pydantic import ValidationError

from station.diagnose.candidates import ACCEL, ENCODER, INPUT, candidates
from station.diagnose.odds import Odds, normalised
from station.diagnose.result import NextExperiment, Rival, Verdict
from station.diagnose.thresholds import BELIEVABLE, LISTED, LOG_PRIOR, LOG_PRIOR_PARAMETER, SURE
from station.estimation.cause import Key, Sizes, constant, constant_path, is_constant
from station.estimation.parameters import CLOCK_SIGMA, WIDE
from station.model.effects import Stage, effect_class
from station.model.units import UNITS, UnknownUnitError, dimension, powers
from station.rig import Rig

LONGEST_LIST = 5
"""Rivals listed without an equivalence, at most."""
CLOCK = ("clock_scale", "clock")
TILT, RIPPLE = ("gravity_tilt", "base"), ("torque_ripple", "motor")
GAIN = constant("motor.gain")


@dataclass(frozen=True)
class Setting:
    """What decides, beside the causes, whether an equivalence applies."""

    rig: Rig
    """As given, without the causes."""
    clock: bool
    """Whether a second clock watched the board's."""
    released: tuple[float, ...]
    """Starting angles, rad, of the runs that start released, with springs relaxed."""

    @property
    def allowed(self) -> frozenset[Key]:
        """What may be a cause on this rig."""
        return frozenset(candidate.key for candidate in candidates(self.rig))


@dataclass(frozen=True)
class Side:
    """A set of causes and the rig in which they do the same as those named."""

    causes: frozenset[Key]
    rig: Rig
    log_odds: float
    """Of this side against the one named, before any data."""


@dataclass(frozen=True)
class Equivalence:
    """One row of the table."""

    name: str
    sentence: str
    tells: str
    """What would tell the sides apart, since no test does."""
    sides: Callable[[frozenset[Key], Rig, Setting], list[Side]]
    """The other sides of (causes, the rig with them, setting); none where it does not apply."""


@dataclass(frozen=True)
class Standing:
    """An equivalence that applies to the causes named, and its other sides."""

    equivalence: Equivalence
    sides: list[Side]


def rescaled(rig: Rig, torque: float = 1.0, length: float = 1.0, time: float = 1.0) -> Rig:
    """The same rig where torques, lengths and times (all constants' and effects') carry these factors."""
    def factor(unit: str) -> float:
        p, q, r = dimension(unit)
        return torque**p * length**q * time**r
    constants = {path: value * factor(UNITS[path]) for path, value in rig.constants().items()}
    effects = [e.model_copy(update={name: value * factor(e.parameters()[name].unit)
                                    for name, value in e.values().items()}) for e in rig.effects]
    return rig.with_constants(constants).with_effects(effects)


def _sizes(rig: Rig) -> Sizes:
    return {(e.name, e.at): e.values() for e in rig.effects}


def _with(rig: Rig, without: Collection[Key], values: Sizes) -> Rig:
    """The rig with some effects replaced by others."""
    kept = [e for e in rig.effects if (e.name, e.at) not in without]
    return rig.with_effects([*kept, *(effect_class(name)(at=at, **v) for (name, at), v in values.items())])


def _paths(causes: frozenset[Key]) -> list[str]:
    """The constants among some causes; not what the rig file holds of effects."""
    return sorted(path for name, _ in causes if is_constant(name) and (path := constant_path(name)) in UNITS)


def moves_by_itself(rig: Rig, setting: Setting) -> bool:
    """Whether some torque acts from sample 0 of a released run without a command: then time 0 is marked in the data."""
    state, unasked = [0.0] * 8, (0.0, 0.0, rig.amplifier.limit)
    return any(type(effect).law(*((angle, 0.0, 0.0) if effect.stage is Stage.TORQUE else unasked),
                                effect.arguments(rig), state, rig.period) != 0.0
               for effect in rig.effects if effect.stage in (Stage.TORQUE, Stage.COMMAND) for angle in setting.released)


def delays_traded(causes: frozenset[Key], rig: Rig, allowed: Collection[Key]) -> list[tuple[frozenset[Key], Sizes]]:
    """Sets with the same sums of delays as some causes (``rig`` has them in it), and these delays.

    Only (input + encoder) and (input + accelerometer) show, so that one of the delays can always be traded away.  None
    that keeps all causes and adds to them: it names no rival in anything's place.
    """
    times = {key: sizes["time"] for key, sizes in _sizes(rig).items() if key in causes & {INPUT, ENCODER, ACCEL}}
    if not times:
        return []
    sums = {key: times.get(INPUT, 0.0) + times.get(key, 0.0)
            for key in ((ENCODER, ACCEL) if rig.accelerometer is not None else (ENCODER,))}
    found = []
    for common in (0.0, min(sums.values())):
        new = {INPUT: common, **{key: total - common for key, total in sums.items()}}
        delays: Sizes = {key: {"time": time} for key, time in new.items() if time > 1e-9}
        other = (causes - frozenset(times)) | frozenset(delays)
        if frozenset(delays) <= set(allowed) and not other >= causes:
            found.append((other, delays))
    return found


def _late(causes: frozenset[Key], rig: Rig, setting: Setting) -> list[Side]:
    """Delays traded, where nothing marks time 0 in the data."""
    return [] if moves_by_itself(rig, setting) else [
        Side(other, _with(rig, causes & {INPUT, ENCODER, ACCEL}, new), LOG_PRIOR * (len(other) - len(causes)))
        for other, new in delays_traded(causes, rig, setting.allowed)]


class _Constants:
    """The prior of a rig's constants and the directions of its units."""

    def __init__(self, causes: frozenset[Key], rig: Rig, setting: Setting) -> None:
        self.causes, self.setting = causes, setting
        self.paths = list(setting.rig.constants())
        nominal, values = setting.rig.constants(), rig.constants()
        self.logs = np.array([math.log(values[p] / nominal[p]) for p in self.paths])
        self.units = [d for d in (powers(self.paths, 0), powers(self.paths, 1)) if np.any(d)]
        self.time = powers(self.paths, 2)

    def bearers(self, direction: np.ndarray) -> set[Key]:
        """The constants that a unit enters, as causes."""
        return {constant(p) for p, power in zip(self.paths, direction, strict=True) if power}

    def covariance(self, causes: frozenset[Key]) -> np.ndarray:
        """Of the logarithms, with a set of causes set free; a clock that is off spreads them along time."""
        found = self.setting.rig.log_covariance(self.paths)
        for path in _paths(causes):
            i = self.paths.index(path)
            found[i, i] += WIDE**2
        if CLOCK in causes:
            found += CLOCK_SIGMA**2 * np.outer(self.time, self.time)
        return found

    def log_odds(self, other: frozenset[Key], directions: Sequence[np.ndarray]) -> float:
        """Of another set against the one named, before the data, where the data leave these directions open."""
        basis = scipy.linalg.null_space(np.array(directions)) if directions else np.eye(self.logs.size)
        seen = basis.T @ self.logs

        def log_density(causes: frozenset[Key]) -> float:
            spread = basis.T @ self.covariance(causes) @ basis
            return float(-0.5 * seen @ np.linalg.solve(spread, seen) - 0.5 * np.linalg.slogdet(spread)[1])

        return LOG_PRIOR * (len(other) - len(self.causes)) + log_density(other) - log_density(self.causes)

    def believable(self, added: Collection[Key]) -> Iterator[tuple[frozenset[Key], float]]:
        """Sets, and their log odds, in which one of ``added`` takes the place of one or more wrong constants."""
        named = [constant(path) for path in _paths(self.causes)]
        rivals = sorted(self.setting.allowed & set(added) - self.causes)
        for gone in (gone for count in range(1, len(named) + 1) for gone in combinations(named, count)):
            rest = self.causes - frozenset(gone)
            least = max(math.log(BELIEVABLE), self.log_odds(rest, self.units))
            for key in rivals:
                log_odds = self.log_odds(rest | {key}, self.units)
                if log_odds > least:
                    yield rest | {key}, log_odds

    def along(self, other: frozenset[Key], direction: np.ndarray, sigma: float = math.inf) -> float:
        """How far along a direction, itself known to sigma, the constants are most probable under another set."""
        precision = np.linalg.inv(self.covariance(other))
        return -float(direction @ precision @ self.logs) / (float(direction @ precision @ direction) + sigma**-2)


def _unit(which: int, causes: frozenset[Key], rig: Rig, setting: Setting) -> list[Side]:
    """Another constant takes over what one unit (0 torque, 1 length) lets move; see the module."""
    known = _Constants(causes, rig, setting)
    direction = powers(known.paths, which)
    if not _paths(causes) or not np.any(direction):
        return []
    found, bearers = [], known.bearers(direction)
    if which == 0 and GAIN in causes:
        factor = setting.rig.motor.gain / rig.motor.gain
        other = (causes | bearers) - {GAIN}
        found.append(Side(other, rescaled(rig, torque=factor), known.log_odds(other, known.units)))
    others = [d for d in known.units if not np.array_equal(d, direction)]
    for other, log_odds in known.believable(bearers):
        if known.log_odds(other, others) < math.log(BELIEVABLE):
            factor = math.exp(known.along(other, direction))
            found.append(Side(other, rescaled(rig, **{("torque", "length")[which]: factor}), log_odds))
    return found


def _time(causes: frozenset[Key], rig: Rig, setting: Setting) -> list[Side]:
    """A clock that is off against constants rescaled, either way round."""
    if setting.clock:
        return []
    known = _Constants(causes, rig, setting)
    if CLOCK in causes:
        ratio = _sizes(rig)[CLOCK]["ratio"]
        other = (causes | known.bearers(known.time)) - {CLOCK}
        return [Side(other, rescaled(_with(rig, [CLOCK], {}), time=1.0 / ratio), known.log_odds(other, known.units))]
    found = []
    for other, log_odds in known.believable([CLOCK]):
        ratio = math.exp(known.along(other - {CLOCK}, known.time, CLOCK_SIGMA))
        found.append(Side(other, _with(rescaled(rig, time=ratio), [], {CLOCK: {"ratio": ratio}}), log_odds))
    return found


def _one_shaft(causes: frozenset[Key], rig: Rig, setting: Setting) -> list[Side]:
    """Without a drive the motor's and the base's inertias only add."""
    if rig.drive is not None or rig.base is None:
        return []
    found = []
    nominal, values = setting.rig.constants(), rig.constants()
    for one, two in (("motor.inertia", "base.inertia"), ("base.inertia", "motor.inertia")):
        moved = values[two] + values[one] - nominal[one]
        if constant(one) in causes and constant(two) not in causes and moved > 0.0:
            found.append(Side((causes - {constant(one)}) | {constant(two)},
                              rig.with_constants({one: nominal[one], two: moved}), 0.0))
    return found


def _tilt(causes: frozenset[Key], rig: Rig, setting: Setting) -> list[Side]:
    """Without a drive a tilt is a ripple of one cycle per turn."""
    if rig.drive is not None or TILT not in causes or RIPPLE in causes or RIPPLE not in setting.allowed:
        return []
    tilt = _sizes(rig)[TILT]
    ripple = {"amplitude": tilt["torque"], "cycles": 1.0, "phase": math.remainder(math.pi - tilt["angle"], math.tau)}
    return [Side((causes - {TILT}) | {RIPPLE}, _with(rig, [TILT], {RIPPLE: ripple}), LOG_PRIOR_PARAMETER)]


TABLE = (
    Equivalence(
        "delays",
        "A command that acts late does exactly what the sensors (encoder, accelerometer) do where all read as late.",
        "only a look at the hardware does, such as an oscilloscope on the amplifier's output and on the encoder's "
        "lines beside the board's samples", _late),
    Equivalence(
        "unit of time",
        "A clock that is off does exactly what constants do that are rescaled by the powers of time in them.",
        "log with host_time beside device_time (station run does): a second clock decides", _time),
    Equivalence(
        "unit of torque",
        "A motor gain that is off does exactly what all inertias, dampings, stiffnesses and torques do that are off "
        "by the inverse.",
        "measure one torque or one inertia by itself, such as the motor's stall torque on a lever and a balance",
        partial(_unit, 0)),
    Equivalence(
        "unit of length",
        "A beam that is longer, with mass_per_length, tip.mass, flexural_rigidity and accelerometer.gain to match, "
        "reads the same.",
        "a ruler and a balance do: measure the beam's length and mass", partial(_unit, 1)),
    Equivalence(
        "one shaft",
        "Without a drive motor and base are one part: only the sum of their inertias shows.",
        "take the motor off its base", _one_shaft),
    Equivalence(
        "tilt or ripple",
        "Without a drive a tilt of the base does exactly what a torque ripple of one cycle per turn does.",
        "turn the rig so that its axis points another way: a tilt turns with it, a ripple does not", _tilt),
)
"""All known equivalences; ``docs/equivalences.md`` proves each, and says when it applies."""


def standing(setting: Setting, causes: frozenset[Key], rig: Rig) -> list[Standing]:
    """The equivalences of which the named causes are one side; ``rig`` has the causes in it, as fitted."""
    found = []
    for equivalence in TABLE if causes else ():
        try:
            sides = equivalence.sides(causes, rig, setting)
        except (UnknownUnitError, ValidationError):
            continue  # an effect of the user's own in other units, or an other side beyond what an effect may be
        if sides:
            found.append(Standing(equivalence, sides))
    return found


def completed(odds: Odds, named: frozenset[Key], known: Sequence[Standing]) -> Odds:
    """Odds in which every other side stands too, as probable as the prior says, but never more than the side named.

    The data say the same of both, so only the prior is between them.
    """
    scores = {keys: math.log(max(p, 1e-300)) for keys, p in odds.sets}
    if not known or named not in scores:
        return odds
    for side in (side for row in known for side in row.sides):
        equal = scores[named] + min(side.log_odds, 0.0)
        scores[side.causes] = max(scores.get(side.causes, -math.inf), equal)
    return normalised(scores, odds.stability)


def exact_sizes(rig: Rig, causes: Collection[Key]) -> list[str]:
    """A sentence where constants or the clock are named and the rig file holds sizes of effects of which it states no
    uncertainty: these are exact, and where they are not all else is off by a unit of torque in their place."""
    exact = sorted({f"{effect.name}.{name}" for effect in rig.effects for name, value in effect.values().items()
                    if value and not rig.uncertainty.get(f"{effect.name}.{name}")})
    if not exact or not any(is_constant(key[0]) or key == CLOCK for key in causes):
        return []
    return [f"the rig file states no uncertainty of {', '.join(exact)}, which is taken for exact; if it is not, state "
            "one under [uncertainty], for what is named may stand in its place"]


def rivals(odds: Odds, named: frozenset[Key], cause: Key, known: Sequence[Standing]) -> list[Rival]:
    """The likeliest causes in place of a named one, and all that are so by an equivalence, however unlikely."""
    others = odds.replacements(named, cause)
    bound = {key for row in known for side in row.sides if cause not in side.causes for key in side.causes - named}
    likely = sorted((key for key in others if key not in bound and others[key] >= LISTED), key=lambda k: -others[k])
    found = [Rival(effect=k[0], at=k[1], probability=others[k]) for k in likely[:LONGEST_LIST]]
    found += [Rival(effect=k[0], at=k[1], probability=max(others.get(k, 0.0), BELIEVABLE))
              for k in sorted(bound)]
    return sorted(found, key=lambda rival: -rival.probability)


def with_word(asked: NextExperiment | None, verdict: Verdict, odds: Odds, named: frozenset[Key],
              known: Sequence[Standing]) -> NextExperiment | None:
    """The next experiment where equivalences stand: what to look at, and no test if nothing else is left open."""
    if not known or verdict not in ("ambiguous", "partly_explained"):
        return asked
    words = ". ".join(f"{row.equivalence.sentence} No test of this station can tell them apart: {row.equivalence.tells}"
                      for row in known)
    alike = {named, *(side.causes for row in known for side in row.sides)}
    settled = verdict == "ambiguous" and sum(p for keys, p in odds.sets if any(s <= keys for s in alike)) >= SURE
    if asked is None or settled:
        return NextExperiment(test=None, why=words)
    return NextExperiment(test=asked.test, why=f"{asked.why}. {words}")
