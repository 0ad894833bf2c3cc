"""Whether logs are what they say: commands of the controller that they name, within what the amplifier gives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.optimize import lsq_linear

from station.control.compensators import commanded
from station.diagnose.thresholds import OWN_COMMANDS
from station.errors import StationError
from station.estimation.noise import QUANTISATION
from station.model.simulate import limit_of
from station.rig import Rig
from station.runs.replay import LIKELY_ROWS, OTHER_ROW, Rows, compensator_of, replay_commands, with_metadata
from station.runs.run import Run

HALF = 0.5
"""Counts by which a command may be another one that was rounded."""
ROUNDS, STEP = 3, 0.01
"""In which what commands were before that is found, and how far derivatives of it reach, counts."""


def as_logged(rig: Rig, runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """The runs, and a sentence for each thing that is not as it is said.

    A controller that is not the one that gave the commands is taken for unknown: closed again by it, a loop would do
    what no test did.  Which row's readings, and which row's reference, a command came from is taken as the commands
    have it, if they fit one row's and not the stated one's: closed again with another delay, it is another loop.
    """
    limit, said = rig.amplifier.limit, []
    moved = {run.name: rows for run in runs if (rows := own_rows(rig, run)) != Rows.stated(run)}
    for rows in sorted(set(moved.values())):
        such = {run.name: run.metadata.command_row for run in runs if moved.get(run.name) == rows}
        said.append(f"{_most(dict.fromkeys(such, 1.0))}: commands are the controller's of {rows}, which is taken, and "
                    f"the log says {next(iter(such.values()))}")
    runs = [moved[run.name].taken(run) if run.name in moved else run for run in runs]
    beyond = {run.name: reached for run in runs
              if (reached := float(np.max(np.abs(run.command)))) > math.floor(limit + 0.5)}
    shares = [off_by(rig, run) for run in runs]
    away = {run.name: share for run, share in zip(runs, shares, strict=True) if share > OWN_COMMANDS}
    if beyond:
        said.append(f"{_most(beyond)}: commands reach {max(beyond.values()):.4g} counts, and the rig file's "
                    f"amplifier.limit, {limit:.4g}, cuts what is simulated")
    if away:
        said.append(f"{_most(away)}: commands are not those of the controller that the log names (off by "
                    f"{100.0 * max(away.values()):.0f} % of their rms; station replay shows where), which is taken for "
                    "unknown")
    return [with_metadata(run, controller={"kind": "unknown"}) if share > OWN_COMMANDS else run
            for run, share in zip(runs, shares, strict=True)], said


def _most(shares: Mapping[str, float]) -> str:
    """The run of the largest, and how many others there are."""
    name = max(sorted(shares), key=shares.__getitem__)
    return name + (f" and {len(shares) - 1} more" if len(shares) > 1 else "")


def own_rows(rig: Rig, run: Run) -> Rows:
    """Of which rows a run's commands are: the stated ones, unless others leave less than OTHER_ROW of what they miss by
    these, and that is more than rounding."""
    rows, stated = Rows.stated(run), off_by(rig, run)
    if stated * _rms(run.command) <= math.sqrt(QUANTISATION):
        return rows
    others = {other: off_by(rig, other.taken(run)) for other in LIKELY_ROWS if other != rows}
    best = min(others, key=others.__getitem__)
    return best if others[best] < OTHER_ROW * stated else rows


def off_by(rig: Rig, run: Run) -> float:
    """By which share of their rms a run's commands are not its controller's; 0 where that cannot be worked out.

    What it remembers when the log begins, or goes on after a gap over which nobody knows what it read, is taken from
    the log: those rows say nothing of it.  What an accelerometer's loop remembers no log says.  Commands were rounded,
    and what it remembers was not: an integral keeps the difference for good, so it is what suits the log best.
    """
    if run.open_loop or commanded(run.metadata.controller):
        return 0.0
    try:
        limit = limit_of(rig, run.metadata)
        compensator, told = compensator_of(run, limit), run.blank
        memory = compensator.memory - run.metadata.command_row
        if compensator.accel_denominator.size:
            told = np.logical_or.accumulate(told | bool(run.command[:memory].any()))
        starts = np.array([0, *(np.flatnonzero(np.diff(told.astype(int)) < 0) + 1)])
        for first in starts:
            told[first: first + memory] = True
        found = replay_commands(run, limit, told=told)
        away = found - run.command
        if run.rounded and _rms(away[~told]) > math.sqrt(QUANTISATION):
            judged = starts[starts + memory < len(run)] + memory
            away = _remembered(run, limit, told, judged, compensator.memory) - run.command
    except StationError:    # told where the loop is simulated
        return 0.0
    return _rms(away[~told]) / max(_rms(run.command), 1e-300)


def _remembered(run: Run, limit: float, told: np.ndarray, starts: np.ndarray, memory: int) -> np.ndarray:
    """(n) the commands, worked out from ``starts`` on with what those before them may have been before they were
    rounded, as suits the log best (Gauss and Newton: a limit makes it no straight line)."""
    run = with_metadata(run, controller={**run.metadata.controller, "rounding": False})
    more = np.zeros((memory, starts.size))

    def worked_out(more: np.ndarray) -> np.ndarray:
        command = run.command.copy()
        for back, away in enumerate(more, start=1):
            command[starts - back] += away
        return replay_commands(replace(run, command=command), limit, told=told)

    found = worked_out(more)
    for _ in range(ROUNDS):
        columns = np.array([worked_out(more + STEP * one[:, None]) - found for one in np.eye(memory)]) / STEP
        for k, (first, end) in enumerate(pairwise([*starts.tolist(), len(run)])):
            rows = np.flatnonzero(~told[first:end]) + first
            if rows.size and memory:
                ends = -HALF - more[:, k], HALF - more[:, k]
                more[:, k] += lsq_linear(columns[:, rows].T, (run.command - found)[rows], bounds=ends).x
        found = worked_out(more)
        if _rms((run.command - found)[~told]) <= math.sqrt(QUANTISATION):
            break
    return np.floor(found + 0.5)


def _rms(values: np.ndarray) -> float:
    return float(np.linalg.norm(values)) / math.sqrt(max(len(values), 1))
