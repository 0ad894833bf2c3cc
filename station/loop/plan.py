"""A plan: several tests, repeated, in written or random order, that one command runs and resumes.

    name = "friction day"
    controller = "lead"          # of the tests that name none: a name, a TOML file, or a table
    repeats = 3
    order = "random"             # or "written"
    seed = 7                     # of the random order
    settle = 2.0                 # s to wait before each test
    answer_ticks = 1             # ticks from a sample to its command, as the line needs them (1 to 4)
    rest_within = 256            # counts from where the first test began; beyond it the plan stops
    tags = ["friction"]

    [limits]                     # as in a rig file; they can only tighten the rig's own
    travel = 3.0

    [[test]]
    kind = "step"                # the keys of `station run step`, and name, controller, repeats, tags
    amplitude = 100

    [[test]]
    kind = "recorded"            # the reference of a logged run
    file = "reference.mcap"

Files that a plan names are read, relative to its own folder; nothing is written but into ``--out``.
"""

from __future__ import annotations

import hashlib
import random
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from station.control.compensators import Compensator
from station.control.references import LEAST_REST, reference_from_test
from station.device.line import MOST_ANSWER_TICKS
from station.errors import UsageError, WorkError
from station.loop.safety import require_rest, require_within_limits
from station.rig import Limits, Rig, problems
from station.runs import load_run
from station.runs.notes import require_tags
from station.runs.run import Run

MAX_FILE_BYTES = 1 << 20
MAX_TRIALS = 1000
RECORDED = "recorded"
OPEN = frozenset({"pulse", "pulse_train"})
"""Kinds that run open loop where neither test nor plan names a controller."""

ControllerOf = Callable[[str, Path], dict[str, Any]]
"""controller_of(name or path, folder): the controller's dictionary; UsageError where there is none."""


Tags = Annotated[tuple[str, ...], Field(strict=False)]
"""A file's list is taken; what stands in it must be text."""


class _Test(BaseModel):
    model_config = ConfigDict(frozen=True, extra="allow", strict=True)

    kind: str
    name: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    controller: str | dict[str, Any] | None = None
    repeats: Annotated[int, Field(ge=1, le=MAX_TRIALS)] | None = None
    tags: Tags = ()


class _Plan(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    name: Annotated[str, Field(min_length=1, max_length=100)] = "plan"
    controller: str | dict[str, Any] | None = None
    repeats: Annotated[int, Field(ge=1, le=MAX_TRIALS)] = 1
    order: Literal["written", "random"] = "written"
    seed: int = 0
    settle: Annotated[float, Field(ge=0.0, le=3600.0, allow_inf_nan=False)] = 0.0
    answer_ticks: Annotated[int, Field(ge=1, le=MOST_ANSWER_TICKS)] = 1
    rest_within: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    tags: Tags = ()
    limits: Limits | None = None
    test: Annotated[tuple[_Test, ...], Field(min_length=1, max_length=200, strict=False)]


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of a plan: test ``index`` (from 1), its ``repeat`` (from 1), and all that ``run_test`` wants.

    reference: counts, one per tick, from where the arm rests.
    """

    index: int
    repeat: int
    name: str
    test: dict[str, Any]
    controller: dict[str, Any]
    reference: np.ndarray
    tags: tuple[str, ...]

    @property
    def file_name(self) -> str:
        """The log's name in the plan's folder: the same whatever the order."""
        return f"{self.index:02d}-{self.name}-r{self.repeat}.mcap"


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan, checked and laid out for one rig; ``trials`` in the order in which they are run."""

    name: str
    text: str
    seed: int
    order: str
    settle: float
    rest_within: float
    answer_ticks: int
    rig: Rig
    trials: tuple[Trial, ...]

    @property
    def identity(self) -> str:
        """Tells this plan from another, or from an earlier text of it."""
        return f"{self.name}.{hashlib.sha256(self.text.encode()).hexdigest()[:16]}"

    def metadata(self, trial: Trial, home: int, place: int) -> dict[str, Any]:
        """What a trial's run says of the plan: repeats of one test have ``plan`` and ``test_index`` in common."""
        known: dict[str, Any] = {
            "test": trial.test, "plan": self.identity, "test_index": trial.index, "test_name": trial.name,
            "repeat": trial.repeat, "place": place, "order": self.order, "seed": self.seed, "home": home}
        return known | ({"tags": list(trial.tags)} if trial.tags else {})

    def done(self, folder: Path, trial: Trial) -> Run | None:
        """The run of a trial that was made completely; None where it is still to be made.

        UsageError where its file is of another plan.
        """
        path = folder / trial.file_name
        if not path.exists():
            return None
        try:
            run = load_run(path)
        except WorkError:  # cut short before its first row
            return None
        known = run.metadata.entries()
        if known.get("plan") != self.identity:
            raise UsageError(f"{path}: of another plan, or of an earlier text of this one; name another --out")
        return run if known.get("outcome") == "complete" and "cut_short" not in known else None

    @staticmethod
    def set_aside(folder: Path, trial: Trial) -> Path | None:
        """Give a log that ended early another name, so that its test can be made again; nothing is lost."""
        path = folder / trial.file_name
        if not path.exists():
            return None
        number = 1
        while (kept := path.with_name(f"{path.stem}.early{number}.mcap")).exists():
            number += 1
        return path.rename(kept)


def load_plan(path: str | Path, rig: Rig, controller_of: ControllerOf) -> Plan:
    """Read a plan and lay out every test of it; UsageError names file, key and reason.

    All that can be refused is refused here, before anything moves.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise UsageError(f"{path}: larger than 1 MiB, which no plan is")
        text = path.read_text(encoding="utf-8")
        parsed = _Plan.model_validate(tomllib.loads(text))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    except ValidationError as error:
        raise UsageError(f"{path}: {problems(error)}") from None
    limited = rig if parsed.limits is None else rig.model_copy(update={"limits": tightened(rig, parsed.limits)})
    trials: list[Trial] = []
    names: set[str] = set()
    for index, test in enumerate(parsed.test, start=1):
        try:
            made = _trials(index, test, parsed, limited, path.parent, controller_of)
        except UsageError as error:
            raise UsageError(f"{path}: test {index}: {error}") from None
        if made[0].name in names:
            raise UsageError(f"{path}: test {index}: two tests are named {made[0].name}; give one of them a name")
        names.add(made[0].name)
        trials += made
    if len(trials) > MAX_TRIALS:
        raise UsageError(f"{path}: {len(trials)} runs, at most {MAX_TRIALS}")
    trials.sort(key=lambda trial: (trial.repeat, trial.index))
    if parsed.order == "random":
        random.Random(parsed.seed).shuffle(trials)
    half_a_turn = 0.5 * rig.encoder.counts_per_revolution
    return Plan(parsed.name, text, parsed.seed, parsed.order, parsed.settle, parsed.rest_within or half_a_turn,
                parsed.answer_ticks, limited, tuple(trials))


def tightened(rig: Rig, limits: Limits) -> Limits:
    """The tighter of the rig's own limits and others, one by one."""
    own = rig.limits or Limits()
    pairs = {key: (getattr(own, key), getattr(limits, key)) for key in type(limits).model_fields}
    return Limits(**{key: min((v for v in both if v is not None), default=None) for key, both in pairs.items()})


def _trials(index: int, test: _Test, plan: _Plan, rig: Rig, folder: Path, controller_of: ControllerOf) -> list[Trial]:
    chosen = test.controller or plan.controller or ("open" if test.kind in OPEN else "p")
    spec = controller_of(chosen, folder) if isinstance(chosen, str) else dict(chosen)
    compensator = Compensator.from_spec(spec, rig.sample_rate, rig.command_limit)
    if compensator.accel_denominator.size and rig.accelerometer is None:
        raise UsageError(f"controller: rig {rig.name} has no accelerometer")
    asked = {"kind": test.kind, **(test.model_extra or {})}
    if test.kind == RECORDED:
        reference, asked = _recorded(asked, rig, folder, compensator.open_loop)
    else:
        reference = reference_from_test(asked, rig.sample_rate)
    require_rest(reference, rig.sample_rate, compensator.open_loop)
    require_within_limits(rig, reference, compensator.open_loop)
    name = re.sub(r"[^A-Za-z0-9_.+-]", "-", test.name or _name(asked, spec)).lstrip(".")
    tags = tuple(sorted({*plan.tags, *test.tags}))
    require_tags(tags, "tags:")
    return [Trial(index, repeat, name or "test", asked, spec, reference, tags)
            for repeat in range(1, (test.repeats or plan.repeats) + 1)]


def _name(asked: dict[str, Any], spec: dict[str, Any]) -> str:
    size = f"-{asked['amplitude']:g}" if isinstance(asked.get("amplitude"), int | float) else ""
    return f"{asked['kind']}-{spec['kind']}{size}".replace("_", "-")


def _recorded(asked: dict[str, Any], rig: Rig, folder: Path, open_loop: bool) -> tuple[np.ndarray, dict[str, Any]]:
    unknown = asked.keys() - {"kind", "file"}
    if unknown or not isinstance(asked.get("file"), str):
        raise UsageError(f"test.{min(unknown, default='file')}: a recorded test has the key file, the name of a run")
    return recorded_reference(folder / asked["file"], rig.sample_rate, open_loop)


def recorded_reference(path: Path, rate: float, open_loop: bool) -> tuple[np.ndarray, dict[str, Any]]:
    """The reference of a logged run (counts, from its own beginning; in open loop its commands), and its test.

    A rest is put before it where it has less than LEAST_REST seconds of its own.  UsageError where it cannot be read
    or was made at another rate.
    """
    try:
        run = load_run(path)
        run.require_unbroken()
    except WorkError as error:
        raise UsageError(f"test.file: {error}") from None
    if abs(run.sample_rate - rate) > 1e-6 * rate:
        raise UsageError(f"test.file: {path}: {run.sample_rate:g} Hz, the rig runs at {rate:g} Hz")
    reference = run.command.astype(float) if open_loop else run.reference - run.reference[0]
    rest = int(np.argmax(reference != 0.0)) if np.any(reference != 0.0) else len(reference)
    wanted = round(LEAST_REST * rate)
    reference = np.concatenate((np.zeros(max(wanted - rest, 0)), reference))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return reference, {"kind": RECORDED, "file": path.name, "file_sha256": digest,
                       "amplitude": float(np.max(np.abs(reference)))}
