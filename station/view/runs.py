"""The page of a folder of runs: thumbnails, step measures, notes and links, static and offline."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from station import markup
from station.errors import WorkError
from station.runs.quality import quality
from station.runs.run import Run
from station.runs.store import RunSummary, load_run
from station.view.html import render

PAGE = "index.html"
THUMBNAIL = (240, 72)
"""Width and height, pixels."""


def runs_html(folder: Path, found: Sequence[RunSummary]) -> str:
    """The page's HTML; links are relative to ``folder``, all text that comes from files is escaped."""
    reports = sorted(path.relative_to(folder) for path in folder.rglob("*.html") if path != folder / PAGE)
    return render("runs.html.j2", folder=folder.resolve().name, rows=[_row(item) for item in found],
                  reports=[(path.as_posix(), quote(path.as_posix())) for path in reports])


def _row(item: RunSummary) -> dict[str, Any]:
    row: dict[str, Any] = {"name": item.path.name, "link": quote(item.path.name), "item": item,
                           "problem": _here(item.problem, item.path), "quality": None, "picture": ""}
    if item.metadata is None:
        return row
    try:
        run = load_run(item.path)
    except WorkError as error:
        return row | {"problem": _here(str(error), item.path)}
    limit = run.metadata.entries().get("command_limit")
    found = quality(run, float(limit) if isinstance(limit, int | float) else float("inf"))
    return row | {"quality": found if found.overshoot is not None else None, "picture": _picture(run)}


def _here(problem: str | None, path: Path) -> str | None:
    """A complaint by the file's name: where the folder lies is nobody's business on a page that is shared."""
    return problem and problem.replace(str(path), path.name)


def _picture(run: Run) -> str:
    lines = {"encoder": run.encoder} if run.open_loop else {"reference": run.reference, "encoder": run.encoder}
    return markup.plot(run.t, lines, f"{run.name}, counts", *THUMBNAIL, ranges=False)
