"""Run a campaign: every case that is not there yet, each kept as soon as it ends."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from station.campaign import cluster
from station.campaign.folder import CaseFolder
from station.campaign.outcome import Outcome, Task
from station.campaign.processes import Work, over_processes
from station.campaign.program import program_hash

Case = Callable[[Task], Outcome]
"""Makes a case, diagnoses it and holds it against what was hidden; importable by name on every worker."""
Told = Callable[[Task, Outcome | str], None]
"""Called as a case ends, with its outcome or, in one line, why it has none."""


@dataclass
class Results:
    """What a campaign has, in the order of its tasks."""

    outcomes: list[Outcome] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """Why there is no outcome, by the task's label."""
    repeated: int = 0
    """How many of the outcomes were there before."""


def run_campaign(tasks: Sequence[Task], case: Case, out: Path, *, workers: int | None = None,
                 scheduler: cluster.Scheduler | None = None, code: str = "", told: Told | None = None,
                 begun: Callable[[int, int], None] | None = None, plain: bool = False) -> Results:
    """Do the tasks that ``out`` does not hold yet, over ``workers`` processes here or over a scheduler's.

    ``code`` names what the cases depend on beyond the package itself; an outcome by other code is done again.  An
    exception in a case is that case's failure, and is tried again in the next run.  ``begun`` is told how many
    outcomes were there and how many are to do; ``plain`` does without Dask even where it is installed.
    """
    if len({task.label for task in tasks}) < len(tasks):
        raise ValueError("two tasks have the same label")
    kept = CaseFolder(out, f"{program_hash()}{code}")
    found: dict[str, Outcome | str] = {o.label: o for o in so_far(tasks, out, code=code).outcomes}
    results = Results(repeated=len(found))
    left = [task for task in tasks if task.label not in found]
    if begun is not None:
        begun(len(found), len(left))
    if left:
        count = max(min(workers or os.cpu_count() or 1, len(left)), 1)
        with _pool(count, scheduler, plain) as over:
            for task, answer in over(partial(attempt, case, program_hash()), left):
                kept.keep(task, answer)
                found[task.label] = Outcome(**answer["outcome"]) if "outcome" in answer else answer["failure"]
                if told is not None:
                    told(task, found[task.label])
    for task in tasks:
        outcome = found[task.label]
        if isinstance(outcome, str):
            results.failed[task.label] = outcome
        else:
            results.outcomes.append(outcome)
    return results


def so_far(tasks: Sequence[Task], out: Path, *, code: str = "") -> Results:
    """What ``out`` holds of the tasks already."""
    kept = CaseFolder(out, f"{program_hash()}{code}")
    there = [outcome for outcome in map(kept.kept, tasks) if outcome is not None]
    return Results(there, repeated=len(there))


Over = Callable[[Work, Sequence[Task]], Iterator[tuple[Task, dict[str, Any]]]]


@contextmanager
def _pool(workers: int, scheduler: cluster.Scheduler | None, plain: bool) -> Iterator[Over]:
    if scheduler is not None:
        with cluster.remote_client(scheduler) as client:
            yield partial(cluster.over_cluster, client=client)
    elif cluster.available() and not plain:
        with cluster.local_client(workers) as client:
            yield partial(cluster.over_cluster, client=client)
    else:
        yield partial(over_processes, workers=workers)


def attempt(case: Case, program: str, task: Task) -> dict[str, Any]:
    """On a worker: the outcome as plain values, or in one line why there is none."""
    try:
        if program_hash() != program:
            return {"failure": "this worker has another Station than the campaign; install the same on both"}
        outcome = asdict(case(task))
        json.dumps(outcome, allow_nan=False)    # what cannot be kept is a failure of this case
        return {"outcome": outcome}
    except Exception as error:
        return {"failure": f"{type(error).__name__}: {error}".splitlines()[0]}
