"""The plan of a campaign: blind cases on the simulated rig, logged runs, or both; a checked TOML file.

A plan names rigs, effects and run files.  It brings no code along and causes no write.
"""

from __future__ import annotations

import glob
import tomllib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from station.campaign import logs, simulated
from station.campaign.hidden import places
from station.campaign.order import by_share, in_turn
from station.campaign.outcome import Outcome, Task
from station.campaign.summary import title
from station.errors import UsageError, WorkError
from station.estimation.cause import Key, constant
from station.rig import Rig, builtin_rigs, load_rig, problems
from station.runs.store import file_hash

MAX_FILE_BYTES = 1 << 20
MAX_CASES = 100_000
MAX_RUNS = 1000
"""Files of one entry of logs."""

Effort = Literal["quick", "full"]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=100)]
Text = Annotated[str, Field(min_length=1, max_length=4096)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Blind(_Table):
    """Rigs drawn around a nominal one, each with an effect hidden in it, two, or none.

    ``effects`` are hidden in turn, by default all that the rig can have; ``clean`` and ``pairs`` are shares of the
    cases.  Case i has the seed ``first_seed`` + i.
    """

    rig: Text = "sflr"
    cases: Annotated[int, Field(ge=1, le=MAX_CASES)]
    first_seed: Annotated[int, Field(ge=0, le=2**40)] = 1
    effects: Annotated[list[Text], Field(min_length=1)] | None = None
    clean: Share = 0.2
    pairs: Share = 0.1
    effort: Effort | None = None

    @model_validator(mode="after")
    def _shares(self) -> Blind:
        if self.clean + self.pairs > 1.0:
            raise ValueError("clean and pairs are shares of all cases, together at most 1")
        return self


class Known(_Table):
    """A cause that is known to be in the logged runs."""

    effect: Text
    at: str = ""
    parameters: dict[str, float] = Field(default_factory=dict)


class Logs(_Table):
    """Runs of one rig, diagnosed together; ``runs`` are files or patterns beside the plan.

    ``known``: what is known to be there; an empty list says nothing is, none that nobody knows.
    """

    name: Name
    rig: Text
    runs: Annotated[list[Text], Field(min_length=1, max_length=MAX_RUNS)]
    known: list[Known] | None = None
    effort: Effort | None = None


class Plan(_Table):
    """The whole file."""

    effort: Effort = "full"
    blind: Blind | None = None
    logs: Annotated[list[Logs], Field(max_length=MAX_CASES)] = Field(default_factory=list)

    @model_validator(mode="after")
    def _something(self) -> Plan:
        if self.blind is None and not self.logs:
            raise ValueError("nothing to do: give [blind], [[logs]] or both")
        names = [entry.name for entry in self.logs]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"logs: two entries are named {name!r}")
        return self


def load_tasks(path: Path, effort: Effort | None = None) -> list[Task]:
    """The cases of a plan file; UsageError in one line that names the file and the key.

    ``effort`` stands above what the plan says.
    """
    plan = _read(path)
    tasks: list[Task] = []
    if plan.blind is not None:
        tasks += _blind(path, plan.blind, effort or plan.blind.effort or plan.effort)
    for index, entry in enumerate(plan.logs):
        tasks.append(_logged(path, f"logs.{index}", entry, effort or entry.effort or plan.effort))
    return tasks


def case(task: Task) -> Outcome:
    """Do a case of a plan."""
    return {"blind": simulated.case, "logs": logs.case}[task.spec["kind"]](task)


def _read(path: Path) -> Plan:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise UsageError(f"{path}: larger than 1 MiB, which no plan file is")
        return Plan.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    except ValidationError as error:
        raise UsageError(f"{path}: {problems(error)}") from None


def _rig(path: Path, key: str, name: str) -> Rig:
    try:
        return load_rig(name if name in builtin_rigs() else path.parent / name)
    except UsageError as error:
        raise UsageError(f"{path}: {key}: {error}") from None


def _blind(path: Path, blind: Blind, effort: Effort) -> Iterator[Task]:
    rig = _rig(path, "blind.rig", blind.rig)
    try:
        simulated.suited(rig)
        hidden = _chosen(rig, blind.effects)
    except UsageError as error:
        raise UsageError(f"{path}: blind.{error}") from None
    rng = np.random.default_rng([blind.first_seed, 0xCA4])
    pairs = _pairs(hidden, rng)
    causes: dict[str, Iterator[list[Key]]] = {
        "single": ([key] for key in in_turn(hidden, rng)), "clean": iter(lambda: [], None),
        "pair": pairs if blind.pairs else iter(())}
    if blind.pairs and len({name for name, _ in hidden}) < 2:
        raise UsageError(f"{path}: blind.pairs: a pair wants two effects that differ")
    shares = {"single": 1.0 - blind.clean - blind.pairs, "clean": blind.clean, "pair": blind.pairs}
    text = rig.to_toml()
    for index, group in enumerate(islice(by_share(shares), blind.cases)):
        found, seed = next(causes[group]), blind.first_seed + index
        label = f"blind-{seed:06d}-{rig.name}-{'+'.join(map(title, found)) or 'clean'}-{effort}"
        yield Task(label, group, {"kind": "blind", "rig": text, "seed": seed, "effort": effort,
                                  "hidden": [list(key) for key in found]})


def _chosen(rig: Rig, names: list[str] | None) -> list[Key]:
    """Effects by name or name@place; all places of a name that stands alone."""
    there = places(rig)
    if names is None:
        return there
    found = []
    for index, text in enumerate(names):
        name, _, at = text.partition("@")
        fitting = [key for key in there if key[0] == name and at in ("", key[1])]
        if not fitting:
            raise UsageError(f"effects.{index}: {text!r} is none of {', '.join(map(title, there))}")
        found += [key for key in fitting if key not in found]
    return found


def _pairs(hidden: list[Key], rng: np.random.Generator) -> Iterator[list[Key]]:
    while True:
        one, other = (hidden[i] for i in rng.choice(len(hidden), 2, replace=False))
        if one[0] != other[0]:
            yield [one, other]


def _logged(path: Path, key: str, entry: Logs, effort: Effort) -> Task:
    rig = _rig(path, f"{key}.rig", entry.rig)
    files: list[Path] = []
    for index, pattern in enumerate(entry.runs):
        try:
            found = sorted(glob.glob(pattern, root_dir=path.parent, recursive=True))
        except ValueError as error:
            raise UsageError(f"{path}: {key}.runs.{index}: {error}") from None
        matches = [file for file in (path.parent / name for name in found) if file.is_file()]
        if not matches:
            raise UsageError(f"{path}: {key}.runs.{index}: no file matches {pattern!r}")
        files += [file for file in matches if file not in files]
        if len(files) > MAX_RUNS:
            raise UsageError(f"{path}: {key}.runs.{index}: more than {MAX_RUNS} files")
    known = None
    if entry.known is not None:
        known = [_known(path, f"{key}.known.{i}", rig, cause) for i, cause in enumerate(entry.known)]
    try:
        runs = [{"path": str(file.resolve()), "sha256": file_hash(file)} for file in files]
    except WorkError as error:
        raise UsageError(f"{path}: {key}.runs: {error}") from None
    return Task(f"logs-{entry.name}-{effort}", "logs", {
        "kind": "logs", "rig": rig.to_toml(), "runs": runs, "known": known, "effort": effort})


def _known(path: Path, key: str, rig: Rig, cause: Known) -> dict[str, Any]:
    """The cause as outcomes hold it, after a look whether the rig can have it."""
    there = sorted({*places(rig), ("clock_scale", "clock"), *map(constant, rig.constants())})
    if (cause.effect, cause.at) not in there:
        fitting = [title(k) for k in there if k[0] == cause.effect]
        hint = f"; this rig can have {', '.join(fitting)}" if fitting else ""
        raise UsageError(f"{path}: {key}: rig {rig.name} has no {title((cause.effect, cause.at))}{hint}")
    return {"effect": cause.effect, "at": cause.at, **cause.parameters}
