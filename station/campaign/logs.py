"""A case of logged runs: read as `station diagnose` reads them, diagnosed, held against what is known, if anything."""

from __future__ import annotations

from pathlib import Path

from station.campaign.outcome import Outcome, Task, diagnosed
from station.errors import WorkError
from station.rig import Rig
from station.runs import load_run
from station.runs.store import file_hash


def case(task: Task) -> Outcome:
    """The runs of the task's files, which must be the very ones that the plan found."""
    spec = task.spec
    rig = Rig.from_toml(spec["rig"], source=f"{task.label}: rig")
    runs = []
    for row in spec["runs"]:
        path = Path(row["path"])
        if file_hash(path) != row["sha256"]:
            raise WorkError(f"{path}: changed since the campaign began")
        runs.append(load_run(path))
    names = [run.name for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise WorkError(f"two runs are named {name}; rename one of their files")
    return diagnosed(task, rig, runs, spec["effort"], hidden=spec["known"])
