"""The folder of a campaign: one file per case, whole or not there."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

from station.campaign.outcome import Outcome, Task
from station.errors import WorkError

SCHEMA = "station-campaign-case/1"
MAX_NAME = 100


def file_name(label: str) -> str:
    """A file's name for a label, whatever it holds; a changed one carries a hash, so that names stay apart."""
    plain = re.sub(r"[^A-Za-z0-9_@+=.-]+", "-", label).strip(".-")[:MAX_NAME]
    return plain if plain == label else f"{plain}-{hashlib.sha256(label.encode()).hexdigest()[:8]}"


class CaseFolder:
    """Outcomes kept in ``out/cases``; ``code`` tells what made them."""

    def __init__(self, out: Path, code: str) -> None:
        self.path, self.code = out / "cases", code
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WorkError(f"{self.path}: cannot be made: {error.strerror or error}") from None

    def kept(self, task: Task) -> Outcome | None:
        """The outcome of this very task by this very code, if it is there and whole."""
        try:
            found = json.loads(self._file(task).read_text(encoding="utf-8"))
            if found["schema"] == SCHEMA and found["code"] == self.code and found["task"] == _plain(asdict(task)):
                return Outcome(**found["outcome"])
        except (OSError, ValueError, KeyError, TypeError):
            pass
        return None

    def keep(self, task: Task, answer: dict[str, Any]) -> None:
        """Write a case's outcome, or why there is none; a reader finds the old file or the new one."""
        path = self._file(task)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        content = {"schema": SCHEMA, "code": self.code, "task": asdict(task), **answer}
        try:
            part.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")
            os.replace(part, path)
        except OSError as error:
            raise WorkError(f"{path}: cannot be written: {error.strerror or error}") from None
        finally:
            part.unlink(missing_ok=True)

    def _file(self, task: Task) -> Path:
        return self.path / f"{file_name(task.label)}.json"


def _plain(value: Any) -> Any:
    """As JSON gives it back: tuples are lists."""
    return json.loads(json.dumps(value))
