"""The page of tests beside the simulation of one rig or of two: offline, in one file; nothing is fitted for it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from station.diagnose.compare import Comparison
from station.diagnose.measures import repeats, step_figures
from station.model.simulate import Simulation
from station.runs.run import Run
from station.view import figures, wording
from station.view.html import render

ROLES = ("before", "after")
"""Of two rigs in their order; one alone is drawn as the second."""


@dataclass(frozen=True)
class Row:
    """One run beside its simulations, each by role."""

    name: str
    test: str
    controller: str
    ahead: float | None
    """Seconds ahead that it is predicted, where its loop cannot be closed again."""
    samples: int
    file_sha256: str | None
    errors: dict[str, dict[str, float]]
    """nrmse of each channel."""
    measured: dict[str, float | None]
    simulated: dict[str, dict[str, float | None]]
    """Overshoot, rise and settling time of a step, as ``measured``."""
    repeats: dict[str, float]


def beside_html(compared: Mapping[str, Comparison], hashes: Sequence[str | None] = (),
                written: datetime | None = None) -> str:
    """The page's HTML, Plotly's script included; all text that comes from files is escaped.

    ``compared``: one comparison or two of the same runs, by what their rigs are called; ``hashes``: SHA-256 of each
    run's file; ``written``: the date that it states, by default now.
    """
    roles = dict(zip(ROLES[-len(compared):], compared, strict=True))
    by_role = {role: compared[name] for role, name in roles.items()}
    runs = by_role[ROLES[-1]].runs
    drawn = [{role: one.simulations[r] for role, one in by_role.items()} for r in range(len(runs))]
    points = figures.points_per_line(sum(map(figures.lines_of, runs, drawn)))
    pictures = {f"run-{r}": figures.run_figure(run, made, points, roles)
                for r, (run, made) in enumerate(zip(runs, drawn, strict=True))}
    measured = [dict(zip(by_role, found, strict=True))
                for found in zip(*(one.measures for one in by_role.values()), strict=True)]
    rows = list(map(_row, runs, drawn, measured, repeats(runs), hashes or [None] * len(runs),
                    by_role[ROLES[-1]].seconds_ahead))
    rigs = {name: (text := one.rig.to_toml(), hashlib.sha256(text.encode()).hexdigest())
            for name, one in compared.items()}
    return render("beside.html.j2", figures=pictures, rows=rows, roles=roles, rigs=rigs, points=points,
                  channels=[c for c in wording.CHANNELS if any(c in row.errors for row in rows)],
                  sentence=_sentence(rows, roles), written=(written or datetime.now(UTC)).astimezone(UTC))


def _row(run: Run, made: Mapping[str, Simulation], measured: Mapping[str, dict[str, Any]], spread: dict[str, float],
         sha256: str | None, ahead: float | None) -> Row:
    """One run; ``measured``: by role, as ``compare --json`` has it."""
    errors = {channel: {role: one[channel]["nrmse"] for role, one in measured.items()}
              for channel in figures.channels_of(run, made)}
    about = run.metadata
    return Row(run.name, wording.test_words(about.test), wording.test_words(about.controller), ahead,
               len(run), sha256, errors, step_figures(run, run.encoder),
               {role: {} if ahead else step_figures(run, one.encoder) for role, one in made.items()}, spread)


def _sentence(rows: Sequence[Row], roles: Mapping[str, str]) -> str:
    """How far off the simulations are, in words."""
    told = []
    for channel, called in wording.CHANNELS.items():
        ranges = []
        for role, name in roles.items():
            found = [row.errors[channel][role] for row in rows if channel in row.errors]
            found = [error for error in found if math.isfinite(error)]
            ends = dict.fromkeys(wording.percent(end) for end in (min(found), max(found))) if found else ()
            if ends:
                ranges.append(f"{' to '.join(ends)} as {name} simulates it")
        if ranges:
            told.append(f"the {called} is off by {' and by '.join(ranges)}")
    return f"{len(rows)} run{'' if len(rows) == 1 else 's'}: {'; '.join(told) or 'nothing moves'}"
