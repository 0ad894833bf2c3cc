"""A log of every other tick, spread over the ticks of its rig.

Commands went on between its rows.  Where the log says what gave them they are worked out again: the reference from the
test, where that meets every logged row, and the command by the log's own compensator, corrected by how far it is off
the logged rows beside it.  What the compensator read between them is the reading with which it gives the next logged
command, where that tells a count and no other sensor had a part in it, and else lies on a straight line; from half a
count no command is rounded, for rounded up each time it would be a bias.  What the log does not say lies on a straight
line between its rows: a reference that changed there by another test, and the command with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.control.compensators import Compensator
from station.control.references import reference_from_test
from station.errors import UsageError, WorkError
from station.runs.columns import COLUMNS
from station.runs.replay import command_limit, compensator_of, replay_commands
from station.runs.run import BETWEEN, LOST, SENT, Run

TELLS = 1.0
"""Counts of command per count of a reading from which on a command, rounded to one, tells the reading to a half."""


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
    found["t"] = run.t[0] + 0.5 * ticks / run.sample_rate   # what was a little off its tick would be twice as much
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
        own = _own_commands(run, replace(straight, extra={}), limit)
    except (UsageError, WorkError):
        return straight.command
    off, found = run.command - own[::2], straight.command.copy()
    most = max(limit, float(np.max(np.abs(run.command))))
    between = np.clip(own[1::2] + 0.5 * (off[:-1] + off[1:]), -most, most)
    found[1::2] = np.where(known, between, found[1::2])
    return found


def _own_commands(run: Run, straight: Run, limit: float) -> np.ndarray:
    """(ticks) commands of the log's own compensator."""
    compensator = compensator_of(straight, limit)
    if compensator.open_loop:
        return replay_commands(straight, limit)
    alone = compensator.accel_denominator.size == 0
    readings = _readings(straight, compensator, run.command) if alone else straight.encoder
    smooth = straight.metadata.model_copy(update={"controller": straight.metadata.controller | {"rounding": False}})
    own = replay_commands(replace(straight, encoder=readings, metadata=smooth), limit)
    whole = np.roll(readings == np.round(readings), -straight.metadata.command_row)
    return np.where(whole, np.floor(own + 0.5), own) if run.rounded else own


def _readings(straight: Run, compensator: Compensator, commands: np.ndarray) -> np.ndarray:
    """(ticks) what a compensator that reads no accelerometer read; ``commands`` those of every other tick."""
    found, late = straight.encoder.copy(), -straight.metadata.command_row
    whole = np.array_equal(found[::2], np.round(found[::2]))

    def commanded(read_by: Compensator, tick: int, reading: float) -> float:
        return read_by.step(float(straight.reference[tick + late]), reading, 0.0)

    def next_logged(tick: int, reading: float) -> float:
        tried = compensator.copy()
        out = commanded(tried, tick, reading)
        return out if (tick + late) % 2 == 0 else commanded(tried, tick + 1, float(found[tick + 1]))

    for tick in range(len(found) - late):
        row = tick + late + (tick + late) % 2
        if tick % 2 == 1 and row < len(found):
            first = next_logged(tick, found[tick])
            slope = next_logged(tick, found[tick] + 1.0) - first
            if abs(slope) >= TELLS:
                reading = found[tick] + (commands[row // 2] - first) / slope
                if abs(reading - found[tick]) <= 1.0 + abs(found[tick + 1] - found[tick - 1]):
                    found[tick] = round(reading) if whole else reading
        commanded(compensator, tick, float(found[tick]))
    return found
