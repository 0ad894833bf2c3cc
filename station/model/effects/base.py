"""What an effect is: one named piece of physics, sensing or timing that the linear model leaves out.

An effect is one class in one file of this package.  The class says where it may act, which parameters it has
(unit, bounds, neutral value), at which stage of the simulation it acts, and its law, a plain Python function

    law(x, v, w, p, s, h) -> float

which the stepper compiles once and calls by its address.  ``p`` holds the effect's arguments and ``s`` its
own states (both indexable), ``h`` the step in s.  What x, v, w and the result mean depends on the stage:

=============  ======================================  =============================  =====================
stage          x, v, w                                 result                         acts
=============  ======================================  =============================  =====================
COMMAND        command, 0, amplifier.limit (counts)    command, mean over h           in order of ``order``
TORQUE         angle, speed of the part, 0             torque on it, N m              motor, base
FRICTION       |speed|, 0, load on the gears (N m)     level >= 0, N m; x = 0: held   motor, base, drive
GAP            deflection, 0, 0 (rad)                  what exceeds the gap, rad      drive
SPRING         deflection beyond the gap, speed, 0     torque added, N m              drive, clamp
ACCEL_INPUT    base speed, 0, beam.length              added acceleration, m/s^2      accelerometer
ACCEL_FILTER   acceleration now, one step before, 0    filtered, m/s^2                in order of ``order``
ACCEL_COUNTS   reading with its offset, 0, 0 (counts)  reading, counts                accelerometer
ENCODER        base angle, 0, 0                        counts added                   encoder
=============  ======================================  =============================  =====================

Friction at the drive acts on the motor; its load is the size of the drive's torque.  A friction that may stand at the
drive or, on a rig without one, at the motor has as its load there |motor torque - external torque|.  The three DELAY
stages and CLOCK have no law: their one parameter is read by the stepper's set-up.  Torques are solved for by iteration,
so that their laws are called several times in a step and have no states.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from station.control.named import NAMED
from station.control.references import reference_from_test
from station.errors import UsageError

if TYPE_CHECKING:
    from station.rig import Rig


class Stage(Enum):
    """Where in a simulated sample an effect acts."""

    COMMAND = "command"
    TORQUE = "torque"
    FRICTION = "friction"
    GAP = "gap"
    SPRING = "spring"
    ACCEL_INPUT = "accel_input"
    ACCEL_FILTER = "accel_filter"
    ACCEL_COUNTS = "accel_counts"
    ENCODER = "encoder"
    INPUT_DELAY = "input_delay"
    ENCODER_DELAY = "encoder_delay"
    ACCEL_DELAY = "accel_delay"
    CLOCK = "clock"


PLACES = {Stage.COMMAND: {"amplifier"}, Stage.TORQUE: {"motor", "base"}, Stage.FRICTION: {"motor", "base", "drive"},
          Stage.GAP: {"drive"}, Stage.SPRING: {"drive", "clamp"}, Stage.ACCEL_INPUT: {"accelerometer"},
          Stage.ACCEL_FILTER: {"accelerometer"}, Stage.ACCEL_COUNTS: {"accelerometer"}, Stage.ENCODER: {"encoder"},
          Stage.INPUT_DELAY: {"amplifier"}, Stage.ENCODER_DELAY: {"encoder"}, Stage.ACCEL_DELAY: {"accelerometer"},
          Stage.CLOCK: {"clock"}}
"""Where an effect of each stage may stand."""
STATEFUL = {Stage.COMMAND, Stage.ACCEL_FILTER}
LAWLESS = {Stage.INPUT_DELAY, Stage.ENCODER_DELAY, Stage.ACCEL_DELAY, Stage.CLOCK}
UNIT = re.compile(r"(1|(N|kg|m|s|rad|rev|counts?)(\^\d+)?)([ /](N|kg|m|s|rad|rev|counts?)(\^\d+)?)*")
"""Units as they are written: "N m s^2/rad^2", "1/rev", "1"."""
PICTURES = {"time", "speed", "angle", "deflection", "command", "frequency", "acceleration"}


USUAL_SPEED = 1.4
"""At which the runs move that an effect's guesses of a speed are for, rad/s (root mean square): steps of a quarter of a
turn in a fifth of a second, with the rest after them."""


@dataclass(frozen=True)
class ParameterInfo:
    """One parameter of an effect: its unit, closed bounds, and the value at which the effect does nothing, or at
    infinity nothing that a constant of the rig does not do.

    ``rounded``: a level at which readings stand still, so that all of them have one rounding error.
    """

    unit: str
    low: float
    high: float
    neutral: float | None = None
    periodic: bool = False
    rounded: bool = False

    @property
    def positive(self) -> bool:
        """Whether only the size is unknown, so that its logarithm is the natural coordinate."""
        return self.low >= 0.0


def parameter(unit: str, low: float = -math.inf, high: float = math.inf, *, neutral: float | None = None,
              periodic: bool = False, rounded: bool = False) -> Any:
    """Declare a parameter as a pydantic field that carries its ParameterInfo."""
    info = ParameterInfo(unit, low, high, neutral, periodic, rounded)
    return Field(ge=low, le=high, allow_inf_nan=neutral is not None and math.isinf(neutral),
                 json_schema_extra={"info": info})  # type: ignore[dict-item]


class Effect(BaseModel):
    """Base of all effects; a subclass with a ``name`` joins the catalogue by being imported."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    name: ClassVar[str] = ""
    """What files call it; small letters, digits and underscores, used by no other effect."""
    title: ClassVar[str] = ""
    """What people call it: in the report, the terminal, the pictures."""
    sites: ClassVar[tuple[str, ...]] = ()
    """Places where it may stand; each is a possible cause of its own."""
    stage: ClassVar[Stage]
    """Where in a simulated sample it acts."""
    order: ClassVar[float] = 0.0
    """Place among the effects of the same stage, where that matters; smaller acts first."""
    states: ClassVar[int] = 0
    """How many numbers of its own the law carries from step to step, in ``s``; COMMAND and ACCEL_FILTER alone."""
    law: ClassVar[Callable[..., float] | None] = None
    """The function."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Tables that the rig must have; the table of the place is always needed."""
    absolute: ClassVar[str | None] = None
    """The parameter that refers to the absolute angle, if any: it shifts with a run's encoder zero."""
    waves: ClassVar[str | None] = None
    """The parameter that says how often per turn the law repeats itself, if any: a diagnosis guesses it from the torque
    that is missing, too."""
    simpler: ClassVar[Mapping[str, Mapping[str, str]]] = {}
    """Effects that this one holds as special cases, and must hold against: by name, which of its parameters each of
    theirs is."""
    picture: ClassVar[str] = "time"
    """The picture that shows it, one of PICTURES: what the residual is drawn against in a report."""
    experiment: ClassVar[dict[str, Any]] = {}
    """The test that tells it from its rivals best; empty where none of the station's can."""
    telling: ClassVar[str] = ""
    """What in that test tells it from its rivals, which it names by title or constant; part of a sentence."""
    alike: ClassVar[str] = ""
    """What, of things that are no effect here, does just the same, if anything; a sentence."""

    at: str

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Refuse a class that is not whole where it is written: a TypeError that says what is missing."""
        super().__pydantic_init_subclass__(**kwargs)
        for problem in _problems(cls) if cls.name else ():
            name, cls.name = cls.name, ""  # a class that is refused stays out of the catalogue
            raise TypeError(f"effect {name!r} ({cls.__qualname__}): {problem}")

    @classmethod
    def parameters(cls) -> dict[str, ParameterInfo]:
        """Parameters in the order of their declaration."""
        return {name: field.json_schema_extra["info"]  # type: ignore[misc,index,call-overload]
                for name, field in cls.model_fields.items() if name != "at"}

    @model_validator(mode="after")
    def _known_place(self) -> Effect:
        if self.at not in self.sites:
            raise ValueError(f"{self.name} acts at {' or '.join(self.sites)}, not at {self.at!r}")
        return self

    def values(self) -> dict[str, float]:
        """The parameters' values, by name."""
        return {name: getattr(self, name) for name in self.parameters()}

    def arguments(self, rig: Rig) -> tuple[float, ...]:
        """What the law finds in ``p``; by default the parameters in order."""
        return tuple(self.values().values())

    @classmethod
    def guesses(cls, rig: Rig, at: str) -> list[dict[str, float]]:
        """Sizes from subtle to large, from which a fit may start on this rig."""
        raise NotImplementedError(f"{cls.__name__}.guesses")

    @classmethod
    def guesses_at(cls, rig: Rig, at: str, speed: float) -> list[dict[str, float]]:
        """The guesses for runs that move at ``speed`` (rad/s, root mean square): speeds are in proportion to it."""
        known = cls.parameters()
        factors = {name: speed / USUAL_SPEED for name, info in known.items() if info.unit == "rad/s"}
        return [guess | {name: min(max(guess[name] * factor, known[name].low), known[name].high)
                         for name, factor in factors.items()} for guess in cls.guesses(rig, at)]

    @classmethod
    def ordered(cls, values: dict[str, float]) -> dict[str, float]:
        """Values as a fit moves them, kept together as the class demands."""
        return values

    @classmethod
    def smaller(cls, guesses: Sequence[dict[str, float]], found: dict[str, float]) -> list[dict[str, float]]:
        """Those of the guesses that are larger than what was found, made as small."""
        sizes, smaller = cls._sizes(), []
        for guess in guesses:
            shares = [(found[name] - neutral) / (guess[name] - neutral) for name, neutral in sizes.items()]
            if shares and min(shares) > 0.0 and (share := math.prod(shares) ** (1.0 / len(shares))) < 1.0:
                smaller.append(cls.sized(guess, share))
        return smaller

    @classmethod
    def sized(cls, guess: dict[str, float], factor: float) -> dict[str, float]:
        """A guess so many times its distance from neutral, within bounds."""
        known = cls.parameters()
        return guess | {name: min(max(neutral + factor * (guess[name] - neutral), known[name].low), known[name].high)
                        for name, neutral in cls._sizes().items()}

    @classmethod
    def _sizes(cls) -> dict[str, float]:
        """The parameters that are sizes, with the finite values at which the effect does nothing."""
        return {name: info.neutral for name, info in cls.parameters().items()
                if info.neutral is not None and math.isfinite(info.neutral)}

    @classmethod
    def cases(cls, rig: Rig, at: str, values: dict[str, float]) -> dict[tuple[str, str], dict[str, float]]:
        """Laws, by (effect, place), against which this one must hold where it has these values, simpler ones or such as
        do the same, and the sizes with which they come nearest to it; by default what it holds as special cases, at the
        same place."""
        return {(name, at): {own: values[of] for own, of in its.items()} for name, its in cls.simpler.items()}

    @classmethod
    def largest(cls, rig: Rig, at: str) -> dict[str, float]:
        """Sizes beyond which the law would be another thing than its name says, by parameter; {} where none is.

        An effect is a cause only where the 95 % interval of such a size ends below it.
        """
        return {}

    @classmethod
    def by_load(cls, rig: Rig, at: str) -> bool:
        """Whether the law asks for the load on the gears: friction of a drive, or of what stands for it."""
        return cls.stage is Stage.FRICTION and (at == "drive" or rig.drive is None and "drive" in cls.sites)

    @classmethod
    def fits(cls, rig: Rig, at: str) -> bool:
        """Whether the rig has what the effect acts on; without a drive motor and base turn as one."""
        tables = {"amplifier": "motor", "clock": "motor"} | ({"base": "motor"} if rig.drive is None else {})
        return all(getattr(rig, table) is not None for table in {tables.get(at, at), *cls.needs})


def named(base: type[Effect] = Effect) -> Iterator[type[Effect]]:
    """Every subclass that has a name."""
    for cls in base.__subclasses__():
        if cls.name:
            yield cls
        yield from named(cls)


def _problems(cls: type[Effect]) -> Iterator[str]:
    """What a class lacks or has wrong."""
    if not re.fullmatch("[a-z][a-z0-9_]*", cls.name):
        yield "the name is of small letters, digits and underscores"
    for other in named():
        if other.name == cls.name and (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
            yield f"the name is taken by {other.__module__}.{other.__qualname__}"
    for field_name, field in cls.model_fields.items():
        info: Any = (field.json_schema_extra or {}).get("info")  # type: ignore[union-attr]
        if field_name != "at" and info is None:
            yield f"{field_name} is not declared by parameter(unit, low, high)"
        elif info is not None and not UNIT.fullmatch(info.unit):
            yield f"{field_name}: a unit is made of N, kg, m, s, rad, rev and counts, not {info.unit!r}"
    if not isinstance(getattr(cls, "stage", None), Stage):
        yield "no stage; one of Stage is wanted"
        return
    if not cls.sites or not set(cls.sites) <= PLACES[cls.stage]:
        yield f"sites are of {', '.join(sorted(PLACES[cls.stage]))} for a {cls.stage.value}, not {cls.sites!r}"
    if cls.stage in LAWLESS:
        if len(cls.parameters()) != 1:
            yield f"a {cls.stage.value} has one parameter"
    elif not callable(cls.law) or len(inspect.signature(cls.law).parameters) != 6:
        yield "law is a function of x, v, w, p, s, h"
    if cls.states and cls.stage not in STATEFUL:
        yield f"a {cls.stage.value} has no states: its law is called several times in a step"
    for name, its in cls.simpler.items():
        if not set(its.values()) <= set(cls.parameters()):
            yield f"simpler: {name} is made of parameters of this effect, not of {', '.join(its.values())}"
    if cls.picture not in PICTURES:
        yield f"picture is one of {', '.join(sorted(PICTURES))}, not {cls.picture!r}"
    if cls.experiment:
        test = {"amplitude": 1.0, **cls.experiment}
        if test.pop("controller", "p") not in NAMED:
            yield f"experiment.controller is one of {', '.join(NAMED)}, not {cls.experiment['controller']!r}"
        try:
            reference_from_test(test, 500.0)
        except UsageError as error:
            yield f"experiment: {error}"
    if all(info.neutral is None for info in cls.parameters().values()):
        yield "no parameter has a neutral value, at which the effect does nothing"
    if cls.absolute is not None and cls.absolute not in cls.parameters():
        yield f"absolute names no parameter: {cls.absolute!r}"
    if "guesses" not in {name for base in cls.__mro__[:-1] if base is not Effect for name in vars(base)}:
        yield "no guesses, the sizes from which a fit starts"


SHOWN = 0.1
"""Most waves per count that an encoder shows: ten counts to each."""


def torque_scale(rig: Rig) -> float:
    """The motor's largest torque, N m."""
    return abs(rig.motor.gain) * rig.amplifier.limit
