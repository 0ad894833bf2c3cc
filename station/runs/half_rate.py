"""A log of every other tick, spread over the ticks of its rig.

Commands went on between its rows.  Where the log says what gave them they are worked out again: the reference from the
test, where that meets every logged row, and the command by the log's own compensator from readings on a straight line,
corrected by how far it is off the logged rows beside it.  What the log does not say lies on a straight line between its
rows: a reference that changed there by another test, and the command with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.control.references import reference_from_test
from station.errors import UsageError, WorkError
from station.runs.columns import COLUMNS
from station.runs.replay import command_limit, replay_commands
from station.runs.run import BETWEEN, LOST, SENT, Run, RunMetadata


def spread(run: Run) -> Run:
    """The same run with a lost row after every row but the last; a 1 in the extra column ``lost`` marks them."""
    run = run.filled()
    rows, ticks = np.arange(len(run)), np.arange(2 * len(run) - 1)
    found = {name: np.interp(0.5 * ticks, rows, values) if name in BETWEEN or name in SENT else values[ticks // 2]
             for name, values in run.columns().items()}
    for column in COLUMNS:
        if column.gaps and column.name in found:
            found[column.name] = np.where(ticks % 2 == 1, np.nan, found[column.name])
    lost = (ticks % 2 == 1) | ~run.logged[ticks // 2]
    known = _reference(run)
    if known is not None:
        found["reference"] = known
    straight = Run.from_columns(run.name, run.name, found | {"n": ticks, LOST: lost.astype(float)}, run.metadata)
    still = np.diff(run.reference) == 0.0
    return replace(straight, command=_command(run, straight, still if known is None else np.ones_like(still)))


def _reference(run: Run) -> np.ndarray | None:
    """(ticks) the test's own reference where all logged rows are its, from one level."""
    try:
        known = reference_from_test(run.metadata.test, 2.0 * run.sample_rate)[: 2 * len(run) - 1]
    except UsageError:
        return None
    if len(known) < 2 * len(run) - 1 or np.ptp(run.reference - known[::2]) > 0.0:
        return None
    return known + (run.reference[0] - known[0])


def _command(run: Run, straight: Run, known: np.ndarray) -> np.ndarray:
    """(ticks) commands, of the compensator where the log names one and the reference after a row is ``known``."""
    try:
        limit = command_limit(run)
    except UsageError:
        limit = float(np.max(np.abs(run.command)))
    try:
        own = replay_commands(replace(straight, extra={}, metadata=_unrounded(run.metadata)), limit)
    except (UsageError, WorkError):
        return straight.command
    off, found = run.command - own[::2], straight.command.copy()
    found[1::2] = np.where(known, own[1::2] + 0.5 * (off[:-1] + off[1:]), found[1::2])
    return found


def _unrounded(metadata: RunMetadata) -> RunMetadata:
    """The same with commands that are not rounded: half a count is a common reading between two rows, and rounded up
    each time it is a bias."""
    return metadata.model_copy(update={"rounding": False, "controller": metadata.controller | {"rounding": False}})
