"""The rig: constants in SI units, their uncertainty, and the effects that it is known to have; TOML in and out.

Parts may be left out.  No ``drive``: motor and base turn as one.  No ``clamp``: the beam's root is fixed to the
base.  No ``beam``: no clamp, tip or accelerometer.  Without drive, base and beam it is a rigid axis whose motor
carries the encoder (for a linear axis read m for rad, kg for kg m^2, N for N m).
"""

from __future__ import annotations

import math
import tomllib
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_serializer, field_validator, model_validator
from pydantic_core import ErrorDetails

from station import markup
from station.errors import UsageError
from station.model.effects import Effect, effect_class

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

MAX_FILE_BYTES = 1 << 20
MAX_PROBLEMS = 6
"""Keys that one message names."""
PROFILE = frozenset(f"beam.rigidity_{k}" for k in (1, 2, 3))
"""Constants that are exact unless the file states an uncertainty."""
EXACT = frozenset({"amplifier.limit", "motor.back_emf", "encoder.counts_per_revolution", "beam.elements", "beam.mesh"})
"""Keys of a rig that carry no uncertainty."""
MAX_SIGMA = math.pi
"""Largest uncertainty: a constant may be 23 times what the file says or a 23rd of it, an angle anywhere."""
MAX_ELEMENTS = 200
MESH_ACCURACY = 0.0025
"""Relative error of a bending wave's frequency on a refined mesh, at a quarter of the sample rate."""
DOUBLINGS = 2
"""Most doublings of a mesh in a fit: four times the elements take about ten times as long to decouple,
sixteen times two hundred."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Amplifier(_Table):
    """limit: largest command, counts."""

    limit: Positive


class Motor(_Table):
    """inertia kg m^2, damping N m s/rad, gain N m per count (a negative gain keeps its sign).

    back_emf: share of the damping that is back-EMF, which no gear carries; the rest rubs.  It matters to a friction
    that grows with the load on the gears of an axis without a drive, and to nothing else.
    """

    inertia: Positive
    damping: NotNegative
    gain: Annotated[float, Field(allow_inf_nan=False)]
    back_emf: Annotated[float, Field(ge=0, le=1)] | None = None
    """None: not known; simulated as 1."""

    @property
    def electrical_damping(self) -> float:
        """What of the damping is back-EMF, N m s/rad."""
        return self.damping * (1.0 if self.back_emf is None else self.back_emf)

    @field_validator("gain")
    @classmethod
    def _drives(cls, gain: float) -> float:
        if gain == 0.0:
            raise ValueError("a motor without gain cannot be driven")
        return gain


class Joint(_Table):
    """stiffness N m/rad and damping N m s/rad of a torsional spring and damper (TSD)."""

    stiffness: Positive
    damping: NotNegative


class Base(_Table):
    """inertia kg m^2."""

    inertia: Positive


class Beam(_Table):
    """mass_per_length kg/m, length m, flexural_rigidity N m^2, damping s (stiffness-proportional), elements.

    rigidity_k, k = 1, 2, 3: the rigidity at x is flexural_rigidity times the product of all rigidity_k to the power of
    cos(k pi x/length); all 1 for a uniform beam.  ``elements`` is the least number where the mesh is ``refined`` (see
    ``Rig.meshed``), the number where ``as_stated``.
    """

    mass_per_length: Positive
    length: Positive
    flexural_rigidity: Positive
    damping: NotNegative = 0.0
    rigidity_1: Positive = 1.0
    rigidity_2: Positive = 1.0
    rigidity_3: Positive = 1.0
    elements: Annotated[int, Field(ge=1, le=MAX_ELEMENTS)] = 4
    mesh: Literal["refined", "as_stated"] = "refined"

    @property
    def profile(self) -> tuple[float, ...]:
        """rigidity_1, rigidity_2, ..."""
        return self.rigidity_1, self.rigidity_2, self.rigidity_3


class Tip(_Table):
    """The sensor, a point at the beam's end: mass kg, inertia kg m^2."""

    mass: NotNegative
    inertia: NotNegative = 0.0


class Encoder(_Table):
    """counts_per_revolution, of the base: with a [drive] the encoder is on the load's side of it, not on the motor.

    docs/other_rig.md describes a rig whose encoder is on the motor.
    """

    counts_per_revolution: Positive


class Accelerometer(_Table):
    """gain: counts per m/s^2."""

    gain: Annotated[float, Field(allow_inf_nan=False)]

    @field_validator("gain")
    @classmethod
    def _reads(cls, gain: float) -> float:
        if gain == 0.0:
            raise ValueError("an accelerometer without gain reads nothing; leave the table out")
        return gain


class Limits(_Table):
    """travel: rad from the start of a session; speed: rad/s; command: counts.  Host and device both hold them."""

    travel: Positive | None = None
    speed: Positive | None = None
    command: Positive | None = None


class Rig(_Table):
    """The machine under test; see the module for the parts that may be left out."""

    name: Annotated[str, Field(min_length=1, max_length=100)]
    sample_rate: Annotated[float, Field(gt=0, le=1e5, allow_inf_nan=False)]
    amplifier: Amplifier
    motor: Motor
    drive: Joint | None = None
    base: Base | None = None
    clamp: Joint | None = None
    beam: Beam | None = None
    tip: Tip | None = None
    encoder: Encoder
    accelerometer: Accelerometer | None = None
    limits: Limits | None = None
    uncertainty: dict[str, NotNegative] = Field(default_factory=dict)
    """One sigma of the natural logarithm; of an effect's angle or phase, rad."""
    effects: Annotated[tuple[Effect, ...], Field(max_length=32)] = ()    # a list is made one by _build_effects

    @field_validator("effects", mode="before")
    @classmethod
    def _build_effects(cls, rows: Any) -> Any:
        if not isinstance(rows, list | tuple):
            raise ValueError("must be a list of tables ([[effects]])")
        built = []
        for index, row in enumerate(rows):
            if isinstance(row, Effect):
                built.append(row)
                continue
            if not isinstance(row, dict) or "effect" not in row:
                raise ValueError(f"[{index}]: the key 'effect' is missing")
            if not isinstance(row["effect"], str):
                raise ValueError(f"[{index}].effect: the name of an effect is wanted, not {row['effect']!r}"[:200])
            try:
                effect = effect_class(row["effect"])
                values = {key: value for key, value in row.items() if key != "effect"}
                if "at" not in values and len(effect.sites) == 1:
                    values["at"] = effect.sites[0]
                built.append(effect.model_validate(values))
            except ValidationError as error:
                raise ValueError(problems(error, f"[{index}].")) from None
            except UsageError as error:
                raise ValueError(f"[{index}]: {error}") from None
        return tuple(built)

    @field_serializer("effects")
    def _dump_effects(self, effects: tuple[Effect, ...]) -> list[dict[str, Any]]:
        return [{"effect": e.name, "at": e.at, **e.values()} for e in effects]

    @model_validator(mode="after")
    def _whole(self) -> Rig:
        if self.beam is None:
            for table in ("clamp", "tip", "accelerometer"):
                if getattr(self, table) is not None:
                    raise ValueError(f"{table}: a rig without a beam has none")
        if self.drive is not None and self.base is None:
            raise ValueError("drive: joins motor and base, but there is no base")
        places = set()
        for effect in self.effects:
            if not effect.fits(self, effect.at):
                raise ValueError(f"effects: {effect.name} at {effect.at}: this rig has no {effect.at}")
            if (effect.name, effect.at) in places:
                raise ValueError(f"effects: {effect.name} stands twice at {effect.at}")
            places.add((effect.name, effect.at))
        known = self._uncertain_names()
        for key, sigma in self.uncertainty.items():
            if key not in known:
                raise ValueError(f"uncertainty.{key}: names no constant, table or effect parameter of this rig")
            if sigma > MAX_SIGMA:
                raise ValueError(f"uncertainty.{key}: one sigma of the natural logarithm (of an angle: rad) is wanted, "
                                 f"at most {MAX_SIGMA:.3g}, not {sigma:g}; 0.2 is 20 %")
        return self

    def _uncertain_names(self) -> set[str]:
        tables = {key.split(".")[0] for key in self.constants()}
        parameters = {f"{e.name}.{p}" for e in self.effects for p in e.parameters()}
        profile = PROFILE if self.beam is not None else ()
        return {"default", *self.constants(), *profile, *tables, *parameters}

    @property
    def period(self) -> float:
        """Nominal sample period, s."""
        return 1.0 / self.sample_rate

    @cached_property
    def angle_per_count(self) -> float:
        """Radians per encoder count."""
        return 2.0 * math.pi / self.encoder.counts_per_revolution

    @property
    def command_limit(self) -> float:
        """Largest command (counts): the amplifier's, or ``limits.command`` where that is less."""
        command = self.limits and self.limits.command
        return min(self.amplifier.limit, command or self.amplifier.limit)

    def constants(self) -> dict[str, float]:
        """The constants that carry uncertainty, as "table.key"; zeros (a part without damping) are left out."""
        found = {}
        for table in ("motor", "drive", "base", "clamp", "beam", "tip", "accelerometer"):
            part = getattr(self, table)
            if part is None:
                continue
            for key in type(part).model_fields:
                path, value = f"{table}.{key}", getattr(part, key)
                exact = path in EXACT or path in PROFILE and not self.uncertainty.get(path)
                if not exact and value != 0.0:
                    found[path] = float(value)
        return found

    def stated(self, path: str) -> float:
        """What the file states of a constant, or of a parameter of an effect that it holds (``gravity_tilt.torque``).

        KeyError: it states no such thing.
        """
        effects = {f"{effect.name}.{name}": value for effect in reversed(self.effects)
                   for name, value in effect.values().items()}
        return {**effects, **self.constants()}[path]

    def with_constants(self, values: dict[str, float]) -> Rig:
        """A copy with some constants replaced ("table.key": value).

        UsageError names the key where this rig has no such constant, or a rig file could not have the value.
        """
        tables: dict[str, dict[str, float]] = {}
        unusual = False
        for path, value in values.items():
            place = _PLACES.get(path)
            if place is None:
                raise UsageError(self._unknown(path))
            table, key = place
            try:
                tables.setdefault(table, {})[key] = number = float(value)
            except (TypeError, ValueError):
                raise UsageError(f"{path}: a number is wanted, not {value!r}") from None
            unusual = unusual or not 0.0 < number < math.inf  # every key may have such a number
        parts = {}
        for table, changed in tables.items():
            part = getattr(self, table)
            if part is None:
                raise UsageError(self._unknown(f"{table}.{min(changed)}"))
            if unusual:
                _require(table, part, changed)
            parts[table] = part.model_copy(update=changed)
        return self._copy(parts)

    def _unknown(self, path: object) -> str:
        return f"{path}: rig {self.name} has no such constant; it has {', '.join(self.constants())}"

    def with_effects(self, effects: tuple[Effect, ...] | list[Effect]) -> Rig:
        """A copy with other effects; UsageError where one is none."""
        for effect in effects:
            if not isinstance(effect, Effect):
                raise UsageError(f"effects: {effect!r:.100} is no effect")
        return self._copy({"effects": tuple(effects)})

    def with_elements(self, least: int) -> Rig:
        """A copy whose beam, if there is one, has at least so many elements: a mesh of few has errors of its own."""
        if self.beam is None or self.beam.elements >= least:
            return self
        return self._copy({"beam": self.beam.model_copy(update={"elements": least})})

    def meshed(self) -> Rig:
        """A copy with the elements that simulations use: the rig file's, and more where its mesh may be refined.

        A bending wave of angular frequency w has the wave number k = (w^2 m/EI)^(1/4); on cubic elements of length h
        with consistent mass its frequency is too high by the share (k h)^4/1440.  So many elements that this is at most
        MESH_ACCURACY at a quarter of the sample rate, the highest at which a sampled loop does much.
        """
        if self.beam is None or self.beam.mesh == "as_stated":
            return self
        return self.with_elements(min(math.ceil(self._wanted_elements(self.beam)), MAX_ELEMENTS))

    def with_fixed_mesh(self) -> Rig:
        """A copy that keeps its elements, whatever its constants become."""
        if self.beam is None:
            return self
        return self._copy({"beam": self.beam.model_copy(update={"mesh": "as_stated"})})

    def remeshed(self) -> Rig:
        """A copy with its elements doubled as often as its constants have left those that the mesh was made for.

        For fits: within a factor of four of a beam's rigidity the mesh stays as it is, so that their steps do not
        change it.  At most DOUBLINGS times: a beam that asks for more is many times as long as the rig file says, and
        what its mesh then lacks (the share above grows with the square of the frequency) is above what it swings at.
        """
        if self.beam is None or self.beam.mesh == "as_stated":
            return self
        doublings = min(round(math.log2(self._wanted_elements(self.beam) / self.beam.elements)), DOUBLINGS)
        return self if doublings <= 0 else self.with_elements(min(self.beam.elements << doublings, MAX_ELEMENTS))

    def _wanted_elements(self, beam: Beam) -> float:
        frequency = 0.25 * 2.0 * math.pi * self.sample_rate
        wave_number = (frequency**2 * beam.mass_per_length / beam.flexural_rigidity) ** 0.25
        return beam.length * wave_number / (1440.0 * MESH_ACCURACY) ** 0.25

    def _copy(self, update: dict[str, Any]) -> Rig:
        copy = self.model_copy(update=update)
        copy.__dict__.pop("angle_per_count", None)
        return copy

    def sigma(self, path: str) -> float:
        """One standard deviation of the natural logarithm of one constant, its table's common factor aside."""
        return self.uncertainty.get(path, self.uncertainty.get("default", 0.02))

    def log_covariance(self, paths: list[str]) -> np.ndarray:
        """Prior covariance (n x n) of the logarithms of the named constants.

        Each has its own sigma; a table with an uncertainty of its own adds one common factor to its inertia,
        damping and gain (of those that the table has).
        """
        covariance = np.diag([self.sigma(path) ** 2 for path in paths])
        for table, common in self.uncertainty.items():
            shared = [i for i, path in enumerate(paths)
                      if path in (f"{table}.inertia", f"{table}.damping", f"{table}.gain")]
            covariance[np.ix_(shared, shared)] += common**2
        return covariance

    def _repr_html_(self) -> str:
        rows = [(path, f"{value:.6g}", f"{100.0 * self.sigma(path):.3g} %") for path, value in self.constants().items()]
        rows += [(f"{e.name} at {e.at}, {key}", f"{value:.6g}", "") for e in self.effects
                 for key, value in e.values().items()]
        return markup.table(("constant (SI)", "value", "sigma"), rows, f"{self.name}, {self.sample_rate:g} Hz")

    @classmethod
    def from_toml(cls, text: str, source: str = "rig") -> Rig:
        """Read a rig from TOML; UsageError names the file, the key's path and the reason."""
        try:
            return cls.model_validate(tomllib.loads(text))
        except tomllib.TOMLDecodeError as error:
            raise UsageError(f"{source}: not TOML: {error}") from None
        except ValidationError as error:
            raise UsageError(f"{source}: {problems(error)}") from None

    def to_toml(self) -> str:
        """The rig file's text; reading it gives the same rig, and [[effects]] may be added at its end."""
        tables = self.model_dump(exclude_none=True, exclude_defaults=False)
        return tomli_w.dumps({key: value for key, value in tables.items() if key != "effects" or value})


_TABLES: dict[str, type[_Table]] = {
    "amplifier": Amplifier, "motor": Motor, "drive": Joint, "base": Base, "clamp": Joint, "beam": Beam,
    "tip": Tip, "encoder": Encoder, "accelerometer": Accelerometer}
_PLACES = {f"{table}.{key}": (table, key) for table, part in _TABLES.items() for key in part.model_fields
           if f"{table}.{key}" not in ("beam.elements", "beam.mesh")}
"""The numbers of a rig's parts that ``with_constants`` replaces, as table and key."""


def _require(table: str, part: _Table, changed: dict[str, float]) -> None:
    """UsageError where a table could not have these values."""
    try:
        type(part).model_validate(vars(part) | changed)
    except ValidationError as error:
        raise UsageError(problems(error, f"{table}.")) from None


def problems(error: ValidationError, table: str = "") -> str:
    """What a file's keys have wrong, in one line; ``table`` stands before each key."""
    found: dict[str, list[str]] = {}
    first = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")  # the misspelt key itself
    for problem in first[:MAX_PROBLEMS]:
        found.setdefault(_reason(problem), []).append((table + ".".join(map(str, problem["loc"]))).rstrip("."))
    told = "; ".join(f"{', '.join(keys)}: {reason}" if any(keys) else reason for reason, keys in found.items())
    return told + (f" (and {len(first) - MAX_PROBLEMS} more)" if len(first) > MAX_PROBLEMS else "")


def _reason(problem: ErrorDetails) -> str:
    known = {"extra_forbidden": "unknown key", "missing": "missing"}.get(problem["type"])
    if known is not None:
        return known
    reason, value = str(problem["msg"]).removeprefix("Value error, "), problem["input"]
    reason = reason[:1].lower() + reason[1:]
    if problem["type"] == "value_error" or not isinstance(value, str | int | float):
        return reason
    quotes = " without quotes" if isinstance(value, str) and problem["type"] in ("float_type", "int_type") else ""
    return f"{reason}{quotes}, not {repr(value)[:60]}"


def builtin_rigs() -> dict[str, str]:
    """Names and TOML texts of the rigs that come with Station."""
    folder = resources.files("station") / "rigs"
    return {Path(item.name).stem: item.read_text(encoding="utf-8")
            for item in sorted(folder.iterdir(), key=lambda item: item.name) if item.name.endswith(".toml")}


def load_rig(name_or_path: str | Path) -> Rig:
    """A rig by built-in name or from a TOML file; UsageError where it is neither."""
    builtin = builtin_rigs()
    if str(name_or_path) in builtin:
        return Rig.from_toml(builtin[str(name_or_path)], source=str(name_or_path))
    path = Path(name_or_path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise UsageError(f"{path}: larger than 1 MiB, which no rig file is")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise UsageError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}; built-in rigs are {', '.join(builtin)}") from None
    return Rig.from_toml(text, source=str(path))
