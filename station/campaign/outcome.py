"""A case to be done, and what is kept of it: plain values, kept as JSON and sent between processes and machines."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from station.estimation.cause import Key

if TYPE_CHECKING:
    from station.rig import Rig
    from station.runs.run import Run


@dataclass(frozen=True)
class Task:
    """One case: its own name, the group that it is counted with, and all that making it needs, as JSON holds it."""

    label: str
    group: str
    spec: dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what was said of it."""

    label: str
    group: str
    hidden: list[dict[str, Any]] | None = None
    """The causes that are there, each with its parameters where they are known; None where nobody knows."""
    outside: bool = False
    """Whether what is hidden is outside the catalogue, so that no cause can be right."""
    severity: list[float | None] = field(default_factory=list)
    verdict: str = ""
    causes: list[dict[str, Any]] = field(default_factory=list)
    gain: dict[str, Any] = field(default_factory=dict)
    ranking: list[tuple[str, str, float, float | None]] = field(default_factory=list)
    """(effect, at, probability, fall of chi squared alone) of every cause that the diagnosis gave a probability."""
    notes: list[str] = field(default_factory=list)
    runs: int = 0
    samples: int = 0
    seconds: float = 0.0
    """Of the diagnosis alone, by the clock; ``cpu`` its processor time, ``making`` the time before it."""
    cpu: float = 0.0
    making: float = 0.0
    peak_mb: float | None = None
    """Largest memory that the worker's process has had so far."""
    unmade: str | None = None
    """Why there is no such case: it is listed, not counted."""

    @property
    def keys(self) -> set[Key]:
        """(effect, at) of what is hidden."""
        return {(cause["effect"], cause["at"]) for cause in self.hidden or []}

    @property
    def said(self) -> list[Key]:
        """(effect, at) of the named causes, the most probable first."""
        return [(cause["effect"], cause["at"]) for cause in self.causes]

    @property
    def rivals(self) -> set[Key]:
        """(effect, at) of all rivals that are listed."""
        return {(rival["effect"], rival["at"]) for cause in self.causes for rival in cause["rivals"]}

    @property
    def clean(self) -> bool:
        """Whether it is known that nothing is hidden."""
        return self.hidden is not None and not self.hidden

    @property
    def named(self) -> bool:
        """Whether the first cause is one that is hidden."""
        return bool(self.causes) and self.said[0] in self.keys

    @property
    def listed(self) -> bool:
        """Whether what is hidden is named, first or not, or listed as a rival."""
        return bool(self.keys & {*self.said, *self.rivals})

    @property
    def errors(self) -> list[tuple[str, float, float]]:
        """(channel, nrmse before, after) over the held-out runs."""
        return [(channel, self.gain[channel]["nrmse_before"], self.gain[channel]["nrmse_after"])
                for channel in ("encoder", "accel") if self.gain.get(channel) is not None]

    @property
    def better(self) -> bool:
        """Whether the held-out error falls in every channel."""
        return bool(self.errors) and all(after < before for _, before, after in self.errors)

    def intervals(self) -> Iterator[tuple[Key, str, bool]]:
        """(cause, parameter, whether its 95 % interval holds the truth) of each named cause that is hidden."""
        for cause in self.causes:
            for hidden in self.hidden or []:
                if (hidden["effect"], hidden["at"]) == (cause["effect"], cause["at"]):
                    for name, estimate in cause["parameters"].items():
                        if name in hidden:
                            key = (cause["effect"], cause["at"])
                            yield key, name, covers(estimate["low"], estimate["high"], hidden[name])

    def stated(self) -> Iterator[tuple[float, bool]]:
        """(probability, whether it is there) of every cause and rival in the diagnosis.

        What is hidden, in the catalogue, and not mentioned was given none.
        """
        said: dict[Key, float] = {}
        for cause in self.causes:
            for one in (cause, *cause["rivals"]):
                key = (one["effect"], one["at"])
                said[key] = max(said.get(key, 0.0), one["probability"])
        yield from self._held(said)

    def ranked(self) -> Iterator[tuple[float, bool]]:
        """The same over every cause that the diagnosis ranks, whether it named it or not."""
        yield from self._held({(effect, at): probability for effect, at, probability, _ in self.ranking})

    def _held(self, said: dict[Key, float]) -> Iterator[tuple[float, bool]]:
        there = set() if self.outside else self.keys
        for key, probability in said.items():
            yield probability, key in there
        yield from ((0.0, True) for _ in there - said.keys())


def covers(low: float, high: float, value: float) -> bool:
    """Whether an interval holds a value; one whose ends are the wrong way round wraps at pi."""
    return low <= value <= high if low <= high else value >= low or value <= high


def finite(value: float | None) -> float | None:
    """The number, or None where JSON has no word for it."""
    return float(value) if value is not None and math.isfinite(value) else None


def diagnosed(task: Task, rig: Rig, runs: Sequence[Run], effort: str, *, hidden: list[dict[str, Any]] | None,
              outside: bool = False, severity: Sequence[float] = (), making: float = 0.0) -> Outcome:
    """Diagnose a case, blind: the rig and the runs alone are given; the rest is only kept beside what is said."""
    from station.diagnose.diagnose import diagnose

    wall, cpu = time.perf_counter(), time.process_time()
    result = diagnose(rig, runs, effort=effort, threads=1)  # a worker per core
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    said = result.diagnosis.model_dump(mode="json", by_alias=True)
    return Outcome(
        label=task.label, group=task.group, hidden=hidden, outside=outside, severity=[finite(s) for s in severity],
        verdict=said["verdict"], causes=said["causes"], gain=said["gain"], notes=list(result.notes), runs=len(runs),
        samples=sum(len(run) for run in runs), seconds=wall, cpu=cpu, making=making, peak_mb=peak_memory(),
        ranking=[(row.effect, row.at, row.probability, finite(row.delta_chi2)) for row in result.ranking])


def peak_memory() -> float | None:
    """Largest memory of this process so far, MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:     # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
