"""One blind case: a rig with a hidden cause, tested, diagnosed, and then held against what was hidden.

The code under test is given the case's runs and the nominal rig `sflr`, nothing else.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from typing import Any

from tests.truth import Case, make_case

BAND = (400.0, 1e5)
"""Severity that every hidden effect is sized for: from twice what the contract calls clear to what nobody overlooks.
`clock_scale` and causes outside the catalogue are not sized, only drawn; a constant, which costs its own uncertainty,
can seldom be as plain: from what the contract calls clear on."""
RUNS = 5

Key = tuple[str, str]


@dataclass(frozen=True)
class Task:
    """One case to be made and diagnosed; without an effect a clean rig."""

    seed: int
    effect: str | None
    at: str | None = None
    effort: str = "full"

    @property
    def label(self) -> str:
        """For tables and file names."""
        return f"{self.effect or 'clean'}{'@' + self.at if self.at else ''}-{self.seed}-{self.effort}"


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what was said of it; plain values, so that it can be kept as JSON."""

    label: str
    hidden: list[dict[str, Any]]
    outside: bool
    severity: float | None
    verdict: str
    causes: list[dict[str, Any]]
    gain: dict[str, Any]
    ranking: list[tuple[str, str, float, float]]
    """(effect, at, probability, fall of chi^2 alone), the first few."""
    notes: list[str]
    seconds: float
    cpu: float

    @property
    def keys(self) -> set[Key]:
        """(effect, at) of what was hidden."""
        return {(cause["effect"], cause["at"]) for cause in self.hidden}

    @property
    def clean(self) -> bool:
        """Whether nothing was hidden."""
        return not self.hidden

    @property
    def named(self) -> bool:
        """Whether the first cause is what was hidden."""
        return bool(self.causes) and (self.causes[0]["effect"], self.causes[0]["at"]) in self.keys

    @property
    def errors(self) -> list[tuple[str, float, float]]:
        """(channel, nrmse before, after) over the held-out runs."""
        return [(channel, self.gain[channel]["nrmse_before"], self.gain[channel]["nrmse_after"])
                for channel in ("encoder", "accel") if self.gain[channel] is not None]

    @property
    def better(self) -> bool:
        """Whether the held-out error falls in every channel."""
        return bool(self.errors) and all(after < before for _, before, after in self.errors)

    def intervals(self) -> Iterator[tuple[str, bool]]:
        """(parameter, whether its 95 % interval holds the truth) of each named cause that was hidden."""
        for cause in self.causes:
            for hidden in self.hidden:
                if (hidden["effect"], hidden["at"]) == (cause["effect"], cause["at"]):
                    for name, estimate in cause["parameters"].items():
                        yield name, covers(estimate["low"], estimate["high"], hidden[name])

    def stated(self) -> Iterator[tuple[float, bool]]:
        """(probability, whether it was there) of every cause and rival that the diagnosis gives a probability."""
        for cause in self.causes:
            for said in (cause, *cause["rivals"]):
                yield said["probability"], (said["effect"], said["at"]) in self.keys


def covers(low: float, high: float, value: float) -> bool:
    """Whether an interval holds a value; one whose ends are the wrong way round wraps at pi."""
    return low <= value <= high if low <= high else value >= low or value <= high


def made(task: Task) -> Case:
    """The case of a task."""
    if task.effect is None:
        return make_case(task.seed, [], count=RUNS)
    wanted = (task.effect, task.at) if task.at else task.effect
    band = "clear" if task.effect.startswith("parameter:") else BAND
    return make_case(task.seed, [wanted], count=RUNS, band=band)


def judge(task: Task) -> Outcome:
    """Make a case, diagnose it blind, open the seal.  Times are those of the diagnosis alone."""
    from station.diagnose.diagnose import diagnose
    from station.rig import load_rig

    case = made(task)
    runs, rig = case.runs, load_rig("sflr")
    wall, cpu = time.perf_counter(), time.process_time()
    result = diagnose(rig, runs, effort=task.effort)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    said = result.diagnosis.model_dump(mode="json", by_alias=True)
    severities = [value for value in case.truth["severity"].values() if math.isfinite(value)]
    return Outcome(
        label=task.label, hidden=case.truth["causes"], outside=bool(case.truth["outside"]),
        severity=severities[0] if severities else None, verdict=said["verdict"], causes=said["causes"],
        gain=said["gain"], notes=list(result.notes), seconds=wall, cpu=cpu,
        ranking=[(row.effect, row.at, row.probability, row.delta_chi2) for row in result.ranking[:8]])


def judge_all(tasks: Sequence[Task], workers: int = 2) -> Iterator[Outcome]:
    """Every task in a process of a small pool, as they end."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(judge, task) for task in tasks]):
            yield done.result()


def table(outcomes: Iterable[Outcome]) -> str:
    """One line per case."""
    lines = [f"{'case':40s} {'severity':>8s}  {'verdict':16s} {'ok':3s} "
             f"{'encoder nrmse':>15s} {'accel nrmse':>15s} {'s':>5s} {'CPU s':>5s}  named"]
    for o in outcomes:
        right = not o.causes if o.clean or o.outside else o.named and o.better
        errors = {channel: f"{before:.3f} > {after:.3f}" for channel, before, after in o.errors}
        named = ", ".join(f"{c['effect']}{'@' + c['at'] if c['at'] else ''} {c['probability']:.2f}" for c in o.causes)
        lines.append(f"{o.label:40s} {o.severity or 0.0:8.0f}  {o.verdict:16s} {'yes' if right else 'NO':3s} "
                     f"{errors.get('encoder', ''):>15s} {errors.get('accel', ''):>15s} {o.seconds:5.1f} {o.cpu:5.1f}"
                     f"  {named or '-'}")
    return "\n".join(lines)


def plain(outcome: Outcome) -> dict[str, Any]:
    """As JSON holds it."""
    return asdict(outcome)
