"""Notes and tags on a run, kept beside its file: a log that was written is never written again.

``step.mcap`` has ``step.notes.json`` beside it, which goes when another run takes its place.  Tags and a note given
when the run was made stand in its metadata; ``tags_of`` and ``notes_of`` give both.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from station.errors import UsageError, WorkError
from station.runs.files import check_input, new_file, reason
from station.runs.run import RunMetadata, parse_json

MAX_BYTES = 1 << 20
MAX_TAG = 40


def notes_path(run: str | os.PathLike[str]) -> Path:
    """The file of notes that goes with a run's file."""
    return Path(run).with_suffix(".notes.json")


def set_notes_aside(run: str | os.PathLike[str]) -> None:
    """Give the notes of a run that was replaced another name, ``.notes.json.old``: they are not the new one's."""
    path = notes_path(run)
    with contextlib.suppress(OSError):
        os.replace(path, path.with_name(f"{path.name}.old"))


def _read(run: Path) -> dict[str, Any]:
    path = notes_path(run)
    if not path.exists():
        return {"tags": [], "notes": []}
    try:
        if path.stat().st_size > MAX_BYTES:
            raise WorkError(f"{path}: larger than 1 MiB, which no file of notes is")
        found = parse_json(str(path), path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise WorkError(f"{path}: cannot be read ({reason(error)})") from None
    tags = found.get("tags") if isinstance(found, dict) else None
    notes = found.get("notes") if isinstance(found, dict) else None
    if not isinstance(tags, list) or not isinstance(notes, list) or not all(isinstance(tag, str) for tag in tags) \
            or not all(isinstance(note, dict) and isinstance(note.get("text"), str) for note in notes):
        raise WorkError(f"{path}: not a file of notes; repair or remove it")
    return {"tags": tags, "notes": notes}


def require_tags(tags: Iterable[str], name: str = "--tag") -> None:
    """UsageError where a tag is none; ``name``: of the option or key that it stands behind."""
    for tag in tags:
        if not tag or len(tag) > MAX_TAG or not tag.isprintable() or "," in tag:
            raise UsageError(f"{name} {tag!r}: 1 to {MAX_TAG} letters without a comma are wanted")


def annotate(run: str | os.PathLike[str], *, tags: list[str] | None = None, without: list[str] | None = None,
             note: str | None = None) -> None:
    """Add tags and a note to a run, take tags away.  UsageError for a tag that is none, WorkError for files."""
    path = check_input(run)
    require_tags(tags or [])
    known = _read(path)
    known["tags"] = sorted({*known["tags"], *(tags or [])} - set(without or []))
    if note:
        known["notes"].append({"written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "text": note})
    with new_file(notes_path(path), overwrite=True) as part:
        part.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def tags_of(run: str | os.PathLike[str], metadata: RunMetadata) -> list[str]:
    """All tags of a run, sorted."""
    own = metadata.entries().get("tags")
    made_with = [str(tag) for tag in own] if isinstance(own, list | tuple) else []
    return sorted({*made_with, *_read(Path(run))["tags"]})


def notes_of(run: str | os.PathLike[str], metadata: RunMetadata) -> list[str]:
    """All notes of a run, the first one that with which it was made."""
    own = metadata.entries().get("note")
    return [*([str(own)] if own else []), *(str(note["text"]) for note in _read(Path(run))["notes"])]
