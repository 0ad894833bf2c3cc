"""A log's commands worked out again from its own reference and readings by its own compensator.

This is how the conventions of a log are checked: which row's readings a command came from (``command_row``),
whether the recursion runs on the limited output, whether the log was rounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from station.control.compensators import Compensator
from station.errors import UsageError, WorkError
from station.runs.run import Run

SHAPED = "reference_shaped"
OTHER_ROW = 0.1
"""Share of what commands miss by the stated rows below which they are of others."""
_AFTER_ACCEL_LOOP = ("gain", "zero", "pole", "rounding")


class Rows(NamedTuple):
    """Of which rows commands are, counted from their own."""

    command_row: int
    reference: int = 0
    """An earlier one's where a board works out a command from what it was told a tick ago, too."""

    @classmethod
    def stated(cls, run: Run) -> Rows:
        """As a log says."""
        return cls(run.metadata.command_row)

    def __str__(self) -> str:
        late = -self.reference
        return f"command_row {self.command_row}" + (
            f", of a reference that acts {late} row{'s' * (late > 1)} after its own" if late else "")

    def taken(self, run: Run) -> Run:
        """The run with these, its reference moved to the rows in which it acts."""
        moved = run.reference[np.maximum(np.arange(len(run)) + self.reference, 0)]
        return replace(with_metadata(run, command_row=self.command_row), reference=moved)


LIKELY_ROWS = (Rows(0), Rows(-1), Rows(-2), Rows(-1, -1), Rows(-2, -2))
"""Of which the commands of a log may be that states others."""


@dataclass(frozen=True)
class ReplayResult:
    """Commands worked out again, against those logged (counts).

    ``row`` is where the difference is largest; ``first_row`` the first row beyond ``tolerance`` (None: there is
    none), ``rows_beyond`` how many there are; ``note`` says what the difference points to.
    """

    commands: np.ndarray
    max_abs_difference: float
    row: int
    tolerance: float
    first_row: int | None
    rows_beyond: int
    note: str

    @property
    def same(self) -> bool:
        """Whether every command lies within the tolerance."""
        return self.first_row is None


def command_limit(run: Run) -> float:
    """The command limit (counts) under which the run was made, else that of the rig that its metadata describe.

    UsageError where they only name the rig.
    """
    rig: Any = run.metadata.rig
    if run.metadata.command_limit is not None:
        return run.metadata.command_limit
    try:
        limit = float(rig["amplifier"]["limit"])
        return min(limit, float((rig.get("limits") or {}).get("command") or limit))
    except (TypeError, KeyError, ValueError, AttributeError):
        raise UsageError(f"{run.name}: the run does not hold its rig's amplifier.limit; name the rig") from None


def compensator_of(run: Run, limit: float, spec: dict[str, Any] | None = None) -> Compensator:
    """The run's own compensator (or another ``spec``), as it is before the first sample."""
    spec = dict(run.metadata.controller) if spec is None else spec
    compensator = Compensator.from_spec(spec, run.sample_rate, limit)
    compensator.reset(float(spec.get("accel_zero", run.metadata.accel_zero)))
    return compensator


def replay_commands(run: Run, limit: float | None = None, *, shaped: bool = False,
                    told: np.ndarray | None = None) -> np.ndarray:
    """The commands (counts) that the run's compensator gives for its logged reference, encoder and accelerometer.

    Row i comes from the reference of row i and the readings of row i + command_row; before the first readings
    the command is 0.  ``limit`` (counts) defaults to that of the rig in the metadata.  With ``shaped`` the logged
    reference after the accelerometer loop is used, and the rest of the compensator alone.  Rounded half up
    where the log is; the recursion never is, but goes on from what was logged in rows that are ``told`` (n, bool).
    """
    run.require_unbroken()
    if run.metadata.controller.get("kind") == "unknown":
        raise WorkError(f"{run.name}: the log names no controller, so that its commands cannot be worked out again; "
                        'say it in the log, as in # controller = {"kind": "p", "gain": 2.0}')
    spec, reference = dict(run.metadata.controller), run.reference
    if shaped:
        if SHAPED not in run.extra:
            raise WorkError(f"{run.name}: the log has no column {SHAPED}")
        reference = run.extra[SHAPED]
        spec = {"kind": "lead", **{key: spec[key] for key in _AFTER_ACCEL_LOOP if key in spec}}
    compensator = compensator_of(run, command_limit(run) if limit is None else limit, spec)
    accel = run.accel
    if accel is None:
        if compensator.accel_denominator.size:
            raise WorkError(f"{run.name}: the compensator reads an accelerometer, the run has none")
        accel = np.zeros(len(run))
    late = 0 if compensator.open_loop else -run.metadata.command_row
    commands = np.zeros(len(run))
    readings = zip(run.encoder.tolist(), accel.tolist(), strict=True)
    for row, (target, reading) in enumerate(zip(reference[late:].tolist(), readings, strict=False), start=late):
        commands[row] = compensator.step(target, *reading)
        if told is not None and told[row]:
            compensator.sent(run.command[row])
    return np.floor(commands + 0.5) if run.rounded else commands


def compare_replay(run: Run, limit: float | None = None, *, shaped: bool = False,
                   tolerance: float = 1e-3) -> ReplayResult:
    """Replay a run and say where, and why, its logged commands are not the compensator's."""
    limit = command_limit(run) if limit is None else limit
    commands = replay_commands(run, limit, shaped=shaped)
    difference = np.abs(commands - run.command)
    beyond = np.flatnonzero(difference > tolerance)
    return ReplayResult(commands, float(difference.max()), int(np.argmax(difference)), tolerance,
                        int(beyond[0]) if beyond.size else None, int(beyond.size),
                        _note(run, commands, beyond, limit, shaped))


def _note(run: Run, commands: np.ndarray, beyond: np.ndarray, limit: float, shaped: bool) -> str:
    if not beyond.size:
        return "every command is the compensator's"
    first = int(beyond[0])
    if run.status is not None and np.all(run.status[beyond] != run.status[0]):
        return f"the device reports another status wherever they differ, from row {first} on: late or held ticks"
    left = float(np.sum(np.abs(commands - run.command)))
    for rows in LIKELY_ROWS:
        if rows != Rows.stated(run) and run.metadata.controller.get("kind") != "open":
            again = replay_commands(rows.taken(run), limit, shaped=shaped)
            if float(np.sum(np.abs(again - run.command))) < OTHER_ROW * left:
                return f"they fit {rows}, the metadata say {run.metadata.command_row}"
    if not shaped and SHAPED in run.extra:
        return f"from row {first} on; replay from {SHAPED} tells whether the accelerometer loop's digits do it"
    if not run.rounded and np.array_equal(run.command, np.floor(commands + 0.5)):
        return "the log was rounded, the metadata say it was not"
    return f"from row {first} on they are not this compensator's"


def with_metadata(run: Run, **metadata: Any) -> Run:
    """The run, some of its metadata others."""
    return replace(run, metadata=run.metadata.model_copy(update=metadata))
