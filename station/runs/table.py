"""Reading a text table: header lines that begin with #, then rows of numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TextIO

import numpy as np

from station.errors import WorkError
from station.runs.columns import MAX_ROWS
from station.runs.files import check_input
from station.runs.run import MAX_METADATA_BYTES

MAX_LINE = 8192


@dataclass(frozen=True)
class Table:
    """Header lines without their #, with line numbers; the column names; values, rows by columns; the line of the
    first row, counted from 1 as editors do."""

    comments: list[tuple[int, str]]
    names: list[str]
    values: np.ndarray
    first_line: int


def read_table(path: Path, delimiter: str, names_in_header: bool) -> Table:
    """Read a table whose names stand in the last header line, or in the first line after the header.

    Raises WorkError, one line naming file and line, for a line that is too long, not UTF-8, of another
    number of fields or not a number, and for too many rows.
    """
    path = check_input(path)
    try:
        with path.open(encoding="utf-8-sig", newline=None) as file:
            comments, names_line, number = _header(path, file)
            names = (comments[-1][1] if names_in_header and comments else names_line or "").split(delimiter)
            names = [name.strip() for name in names]
            if delimiter == "," and len(names) == 1 and (found := _other_delimiter(names[0])):
                raise WorkError(f"{path}: columns stand between {found}; a comma is wanted between columns and a "
                                "point in numbers (a spreadsheet exports such a CSV under an English locale)")
            repeated = next((name for name in names if names.count(name) > 1), None)
            if repeated is not None:
                raise WorkError(f"{path}: the column {repeated[:40]!r} stands twice")
            first = [names_line] if names_in_header and names_line is not None else []
            lines = _rows(path, file, first, number)
            row = next(lines, None)
            if row is None:
                return Table(comments, names, np.zeros((0, len(names))), number + 1)
            try:
                values = np.loadtxt(chain([row], lines), delimiter=delimiter, comments=None, ndmin=2, dtype=np.float64)
            except ValueError:
                raise _bad_row(path, delimiter, names, names_in_header) from None
    except UnicodeDecodeError:
        raise WorkError(f"{path}: not UTF-8 text; save it as CSV in UTF-8") from None
    if values.shape[1] != len(names):
        raise _bad_row(path, delimiter, names, names_in_header)
    return Table(comments, names, values, number if names_in_header else number + 1)


def first_line(path: Path, names_in_header: bool) -> int:
    """The line, counted from 1, of the first row of a table that ``read_table`` reads."""
    with path.open(encoding="utf-8-sig", newline=None) as file:
        number = _header(path, file)[2]
    return number if names_in_header else number + 1


def _other_delimiter(names: str) -> str | None:
    """What stands between the column names where it is no comma, for people."""
    return next((words for mark, words in ((";", "semicolons"), ("\t", "tabs")) if mark in names), None)


def _header(path: Path, file: TextIO) -> tuple[list[tuple[int, str]], str | None, int]:
    """The lines that begin with #, the first line that does not, and its number."""
    comments: list[tuple[int, str]] = []
    room, number = MAX_METADATA_BYTES, 0
    while line := file.readline(room + 1):
        number += 1
        if not line.startswith("#"):
            if len(line) > MAX_LINE:
                raise WorkError(f"{path}: line {number} is longer than {MAX_LINE} characters")
            return comments, line.rstrip("\n"), number
        room -= len(line)
        if room < 0:
            raise WorkError(f"{path}: the header is longer than {MAX_METADATA_BYTES} characters")
        comments.append((number, line[1:].rstrip("\n")))
    return comments, None, number


def _rows(path: Path, file: TextIO, first: list[str], number: int) -> Iterator[str]:
    """The rows' lines, each checked for its length; ``number`` is that of the line before them."""
    yield from first
    rows = len(first)
    while line := file.readline(MAX_LINE + 1):
        number, rows = number + 1, rows + 1
        if len(line) > MAX_LINE:
            raise WorkError(f"{path}: line {number} is longer than {MAX_LINE} characters")
        if rows > MAX_ROWS:
            raise WorkError(f"{path}: more than {MAX_ROWS} rows")
        if line.isspace():
            raise WorkError(f"{path}: line {number} is empty")
        yield line


def _bad_row(path: Path, delimiter: str, names: list[str], names_in_header: bool) -> WorkError:
    """Find the line that numpy refused, to name it."""
    with path.open(encoding="utf-8-sig", newline=None) as file:
        header = True
        for number, line in enumerate(file, start=1):
            if header and line.startswith("#"):
                continue
            if header and not names_in_header:
                header = False
                continue
            header = False
            cells = line.rstrip("\n").split(delimiter)
            if len(cells) != len(names):
                return WorkError(f"{path}: line {number}: {len(cells)} fields where {len(names)} are named; leave out "
                                 "the row or mend it")
            for name, cell in zip(names, cells, strict=True):
                try:
                    np.loadtxt([f"0{delimiter}{cell}"], delimiter=delimiter, comments=None)
                except ValueError:
                    return WorkError(f"{path}: line {number}: {cell[:40]!r} is not a number, in column {name[:40]!r}; "
                                     "leave out the row or write a number there")
    return WorkError(f"{path}: not a table of numbers")
