"""Runs in and out of files of every form, folders of runs, and the rescue of a log cut short."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from station.errors import UsageError, WorkError
from station.runs.columns import BY_NAME, own_names, place
from station.runs.csv_form import read_csv, write_csv
from station.runs.files import check_input, check_output, reason
from station.runs.lab_log import read_lab_log
from station.runs.mcap_log import write_mcap
from station.runs.mcap_read import read_mcap, scan_mcap
from station.runs.notes import notes_of, set_notes_aside, tags_of
from station.runs.rollover import rollover, rollover_fault
from station.runs.run import READ_AS, Run, RunMetadata
from station.runs.table import first_line

_SNIFF_BYTES = 65536


def _read_parquet(path: Path) -> Run:
    from station.runs.parquet import read_parquet
    return read_parquet(path)


def _read_mat(path: Path) -> Run:
    from station.runs.mat import read_mat
    return read_mat(path)


def _write_parquet(run: Run, path: Path, overwrite: bool) -> None:
    from station.runs.parquet import write_parquet
    write_parquet(run, path, overwrite)


def _write_mat(run: Run, path: Path, overwrite: bool) -> None:
    from station.runs.mat import write_mat
    write_mat(run, path, overwrite)


def _write_rrd(run: Run, path: Path, overwrite: bool) -> None:
    from station.runs.rrd import write_rrd
    write_rrd(run, path, overwrite)


READERS: dict[str, Callable[[Path], Run]] = {
    ".mcap": read_mcap, ".csv": read_csv, ".parquet": _read_parquet, ".mat": _read_mat, ".txt": read_lab_log,
}
WRITERS: dict[str, Callable[[Run, Path, bool], None]] = {
    ".mcap": write_mcap, ".csv": write_csv, ".parquet": _write_parquet, ".mat": _write_mat, ".rrd": _write_rrd,
}
_MAGIC = {b"\x89MCAP0\r\n": ".mcap", b"PAR1": ".parquet", b"MATLAB 5.0 MAT-file": ".mat"}
_HDF5 = "an HDF5 file (MATLAB v7.3); save it with -v7, as save('run.mat', '-v7')"
_REFUSED = {b"\x89HDF": _HDF5, b"MATLAB 7.3 MAT-file": _HDF5, b"RRF": "a Rerun recording, an export alone"}


def _form(path: Path) -> str:
    """The suffix of the form that the file's first bytes show, whatever its name; WorkError for none."""
    try:
        with path.open("rb") as file:
            head = file.read(_SNIFF_BYTES)
    except OSError as error:
        raise WorkError(f"{path}: cannot be read ({reason(error)})") from None
    for magic, form in _MAGIC.items():
        if head.startswith(magic):
            return form
    for magic, what in _REFUSED.items():
        if head.startswith(magic):
            raise WorkError(f"{path}: {what}")
    if path.suffix.lower() in (".mcap", ".parquet", ".mat"):
        return path.suffix.lower()
    lines = head.splitlines()
    header = list(takewhile(lambda line: line.startswith(b"#"), lines))
    return ".txt" if header and b"\t" in header[-1] and not _names(lines[len(header):]) else ".csv"


def _names(lines: list[bytes]) -> bool:
    """Whether the first line holds a run's column names, between whatever marks."""
    return bool(lines) and not BY_NAME.keys().isdisjoint(own_names(re.split(r"[,;\t]", lines[0].decode("latin-1"))))


def file_hash(path: Path) -> str:
    """SHA-256 of a file; WorkError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise WorkError(f"{path}: cannot be read ({error.strerror or error})") from None


def load_run(path: str | os.PathLike[str]) -> Run:
    """Read a run from any form that Station reads (MCAP, CSV, a laboratory log, Parquet, MAT), told by content.

    The run's name is the file's without its ending.  Raises WorkError, one line naming the file.
    """
    path = check_input(path)
    return READERS[_form(path)](path)


MOST_COUNTS = 1e8
"""Largest reading of an encoder that is imported: a hundred turns of a million counts."""


def export_run(run: Run, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write a run in the form that the suffix names; WorkError where a file is in the way."""
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise UsageError(f"{path}: no form has the ending {path.suffix!r}; use one of {', '.join(WRITERS)}")
    replaced = path.exists()
    writer(run, path, overwrite)
    if replaced:
        _leave_notes(path)


def _leave_notes(path: Path) -> None:
    """The notes of a run that was replaced are not the new one's; those of a run in another form beside it stay."""
    if not any(path.with_suffix(form).exists() for form in READERS if form != path.suffix.lower()):
        set_notes_aside(path)


def import_run(source: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False,
               **known: Any) -> Run:
    """Read a run and write it anew (``.mcap`` as a rule); ``known`` sets metadata the source does not hold.

    WorkError as ``load_run``, and where the encoder reads what no encoder counts to, or rolls over, or the rate is not
    that of a rig whose tables are given.
    """
    run = load_run(source)
    rig = known.get("rig")
    if isinstance(rig, dict) and (fault := run.rate_fault(rig["sample_rate"])):
        raise WorkError(f"{source}: {fault}")
    far = np.abs(run.encoder) > MOST_COUNTS
    if far.any():
        row = int(np.argmax(far))
        raise WorkError(f"{source}: column encoder, {_place(Path(source), row)}: {run.encoder[row]:g} counts; no arm "
                        "turns so far")
    rolled = rollover(run.encoder, _turn(run.metadata.rig if rig is None else rig))
    if rolled:
        raise WorkError(f"{source}: {rollover_fault(run.encoder, rolled, _place(Path(source), rolled[0]))}")
    entries = run.metadata.entries() | {key: value for key, value in known.items() if value is not None}
    imported = Run.from_columns(str(source), Path(out).stem, run.columns(),
                                RunMetadata.from_entries(str(source), entries))
    export_run(imported, out, overwrite)
    return imported


def _turn(rig: Any) -> float | None:
    """Counts per revolution of a rig's tables; None where they do not say."""
    encoder = rig.get("encoder") if isinstance(rig, dict) else None
    turn = encoder.get("counts_per_revolution") if isinstance(encoder, dict) else None
    return float(turn) if isinstance(turn, int | float) else None


def _place(path: Path, row: int) -> str:
    """Where a row stands in its file, for people."""
    form = _form(path)
    return place(row, first_line(path, names_in_header=form == ".txt") if form in (".csv", ".txt") else None)


def trim(path: str | os.PathLike[str], out: str | os.PathLike[str], begin: float | None = None,
         end: float | None = None, *, overwrite: bool = False) -> Run:
    """Write the rows of a run from ``begin`` to ``end`` (s of its time column) as a run of their own.

    Time and index stay as they were, gaps stay gaps; the metadata's ``trimmed`` says what was cut from which file.
    UsageError where nothing is left or the arm moves where the cut begins, as a run that is simulated starts at rest.
    """
    source = check_input(path)
    run = load_run(source)
    begin = float(run.t[0]) if begin is None else begin
    end = float(run.t[-1]) if end is None else end
    half = 0.5 / run.sample_rate
    rows = np.flatnonzero((run.t >= begin - half) & (run.t <= end + half))
    if len(rows) < 2:
        raise UsageError(f"{path}: no two rows from {begin:g} to {end:g} s; it goes from {run.t[0]:g} to "
                         f"{run.t[-1]:g} s")
    cut = run.slice(int(rows[0]), int(rows[-1]) + 1)
    if rows[0] > 0 and any(values[1] != values[0] for values in (cut.reference, cut.encoder)):
        raise UsageError(f"{path}: at {begin:g} s the arm moves; begin the cut where reference and encoder rest")
    made = {"file": source.name, "sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
            "from": float(cut.t[0]), "to": float(cut.t[-1])}
    entries = run.metadata.entries() | {"trimmed": made}
    trimmed = Run.from_columns(str(path), Path(out).stem, cut.columns(), RunMetadata.from_entries(str(path), entries))
    export_run(trimmed, out, overwrite)
    return trimmed


@dataclass(frozen=True)
class Recovery:
    """What a rescue found: the rows kept, and why the log ended early (None: it was complete)."""

    rows: int
    cut_short: str | None


def recover(path: str | os.PathLike[str], out: str | os.PathLike[str], overwrite: bool = False) -> Recovery:
    """Complete a log that was cut short, or damaged, into a copy that other programs open; the original stays.

    Raises WorkError where nothing can be read, or ``out`` exists and is not to be replaced.
    """
    path, out = check_input(path), check_output(out, overwrite)
    contents = scan_mcap(path, salvage=True)
    metadata = contents.metadata
    if contents.cut_short:
        metadata = metadata.model_copy(update={"recovered": contents.cut_short})
    replaced = out.exists()
    write_mcap(Run.from_columns(str(path), out.stem, contents.columns, metadata), out, overwrite)
    if replaced:
        _leave_notes(out)
    return Recovery(len(contents.columns["t"]), contents.cut_short)


@dataclass(frozen=True)
class RunSummary:
    """One file of a folder of runs: what it holds, or the line that says why it cannot be read."""

    path: Path
    rows: int = 0
    sample_rate: float = 0.0
    metadata: RunMetadata | None = None
    problem: str | None = None
    tags: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem

    @property
    def duration(self) -> float:
        """Seconds from the first row to one period after the last."""
        return self.rows / self.sample_rate if self.sample_rate else 0.0

    @property
    def rig(self) -> str:
        """The rig's name; empty where the run does not say."""
        rig = self.metadata.rig if self.metadata is not None else ""
        return str(rig.get("name", "")) if isinstance(rig, dict) else rig

    @property
    def began(self) -> str:
        """When it was made (UTC, ISO 8601); empty where the run does not say."""
        return str(self.metadata.entries().get("began") or "") if self.metadata is not None else ""

    @property
    def read_as(self) -> str:
        """As ``Run.read_as``."""
        return str(self.metadata.entries().get(READ_AS) or "") if self.metadata is not None else ""

    @property
    def state(self) -> str:
        """Empty for a run that came to its end, else why it did not."""
        known = self.metadata.entries() if self.metadata is not None else {}
        outcome = known.get("outcome", "complete")
        return str(known.get("cut_short") or ("" if outcome in ("complete", None) else outcome))


@dataclass(frozen=True)
class RunFilter:
    """Which runs are wanted; None: whichever.  ``since`` and ``until``: ISO dates or times (UTC), both inclusive."""

    rig: str | None = None
    kind: str | None = None
    controller: str | None = None
    since: str | None = None
    until: str | None = None
    tag: str | None = None
    plan: str | None = None

    def __post_init__(self) -> None:
        for name in ("since", "until"):
            value = getattr(self, name)
            try:
                if value is not None:
                    _moment(value)
            except ValueError:
                raise UsageError(f"--{name} {value}: a date such as 2026-03-31 is wanted") from None

    @property
    def wants_all(self) -> bool:
        """Whether nothing is asked."""
        return self == RunFilter()

    def takes(self, run: RunSummary) -> bool:
        """Whether a run is among them; a file that cannot be read is only where nothing is asked."""
        if run.metadata is None:
            return self.wants_all
        plan = str(run.metadata.entries().get("plan") or "")
        return (self.rig in (None, run.rig)
                and self.kind in (None, run.metadata.test.get("kind"))
                and self.controller in (None, run.metadata.controller.get("kind"))
                and self.tag in (None, *run.tags)
                and self.plan in (None, plan, plan.rpartition(".")[0])
                and (self.since is self.until is None or self._within(run.began)))

    def _within(self, began: str) -> bool:
        """Whether a run that began then lies between the dates; one that does not say when it began does not."""
        try:
            moment = _moment(began)
        except ValueError:
            return False
        if self.since is not None and moment < _moment(self.since):
            return False
        if self.until is None:
            return True
        whole_day = timedelta(days=1) if len(self.until) <= len("2026-03-31") else timedelta(seconds=1)
        return moment < _moment(self.until) + whole_day


def _moment(text: str) -> datetime:
    """A date or time, UTC where it does not say; ValueError where it is none, or a week's."""
    if "W" in text:
        raise ValueError(text)
    found = datetime.fromisoformat(text)
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def list_runs(folder: str | os.PathLike[str]) -> list[RunSummary]:
    """The runs of a folder, by name; files that look like runs and cannot be read are listed with the reason."""
    folder = Path(folder)
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in READERS and path.is_file())
    except OSError as error:
        raise WorkError(f"{folder}: not a folder that can be read ({reason(error)})") from None
    return [_summary(path) for path in paths]


def _summary(path: Path) -> RunSummary:
    try:
        run = load_run(path)
    except WorkError as error:
        return RunSummary(path, problem=str(error))
    except Exception as error:  # a file that a library chokes on hides none of the others
        return RunSummary(path, problem=f"{path}: cannot be read ({type(error).__name__}: {error})")
    try:
        tags, notes = tuple(tags_of(path, run.metadata)), tuple(notes_of(path, run.metadata))
    except WorkError as error:
        return RunSummary(path, len(run), run.sample_rate, run.metadata, notes=(str(error),))
    return RunSummary(path, len(run), run.sample_rate, run.metadata, tags=tags, notes=notes)
