"""A case of logged runs: read as `station diagnose` reads them, diagnosed, held against what is known, if anything."""

from __future__ import annotations

from pathlib import Path

from station.campaign.outcome import Outcome, Task, diagnosed
from station.errors import WorkError
from station.rig import Rig
from station.runs.names import load_runs
from station.runs.store import file_hash


def case(task: Task) -> Outcome:
    """The runs of the task's files, which must be the very ones that the plan found."""
    spec = task.spec
    rig = Rig.from_toml(spec["rig"], source=f"{task.label}: rig")
    paths = [Path(row["path"]) for row in spec["runs"]]
    for path, row in zip(paths, spec["runs"], strict=True):
        if file_hash(path) != row["sha256"]:
            raise WorkError(f"{path}: changed since the campaign began")
    return diagnosed(task, rig, load_runs(paths), spec["effort"], hidden=spec["known"])
