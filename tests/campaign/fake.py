"""Cases that cost nothing, for what runs them: importable by name on every worker."""

from __future__ import annotations

import os
import signal
import time
import uuid
from pathlib import Path

from station.campaign.outcome import Outcome, Task


def task(label: str, folder: Path, **spec: object) -> Task:
    """`do` says what happens: nothing, "fail", or "die" (the first time) or "always die"."""
    return Task(label, "fake", {"folder": str(folder), "do": "", **spec})


def case(task: Task) -> Outcome:
    """Leave a mark for every time it is begun, and the worker's process with it."""
    folder, do = Path(task.spec["folder"]), task.spec["do"]
    first = not list(folder.glob(f"{task.label}.*"))
    (folder / f"{task.label}.{uuid.uuid4().hex}").write_text(str(os.getpid()))
    time.sleep(task.spec.get("seconds", 0.05))
    if do == "fail":
        raise ValueError("this one\ncannot be done")
    if do == "always die" or (do == "die" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(task.label, task.group, hidden=[], verdict="nothing_missing", seconds=float(task.spec.get("n", 0)))


def begun(folder: Path) -> dict[str, int]:
    """How often each label was begun."""
    counts: dict[str, int] = {}
    for mark in folder.iterdir():
        label = mark.name.partition(".")[0]
        counts[label] = counts.get(label, 0) + 1
    return counts
