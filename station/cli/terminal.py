"""What the commands print: plain where no terminal looks on, and never a control character from a file."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from station.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PIPED_WIDTH = 200
STDOUT = "-"
"""For `--json`: standard output."""


def one_line(text: object, limit: int = 600) -> str:
    """A message as one printable line of bearable length."""
    line = printable(" ".join(part.strip() for part in str(text).splitlines() if part.strip()))
    return line if len(line) <= limit else line[: limit - 4] + " ..."


def console() -> Console:
    """Where tables and sentences go: standard output, wide enough for a table when piped."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else PIPED_WIDTH)


def say(text: object = "") -> None:
    """Print a sentence; control characters escaped, no markup."""
    print("\n".join(printable(line) for line in str(text).split("\n")), flush=True)


def note(text: object) -> None:
    """Say on standard error what is going on, so that standard output stays the result."""
    print(one_line(text), file=sys.stderr, flush=True)


def table(title: str, *columns: str) -> Table:
    """A table whose first column holds names and whose others hold numbers."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    made = Table(title=Text(title) if title else None, box=box.SIMPLE, title_justify="left", pad_edge=False)
    for index, column in enumerate(columns):
        made.add_column(Text(column), justify="left" if index == 0 else "right", overflow="fold")
    return made


def row(made: Table, *cells: object) -> None:
    """Add a row; cells are shown as they are, without markup."""
    from rich.text import Text

    made.add_row(*(Text(printable(cell)) for cell in cells))


def number(value: float | None, digits: int = 3, none: str = "-") -> str:
    """A number with so many significant digits."""
    return none if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def quantity(value: float | None, unit: str, digits: int = 4, none: str = "-") -> str:
    """A number with its unit; one without dimension has none, nor has what is no number."""
    text = number(value, digits, none)
    return text if text == none or unit in ("", "1") else f"{text} {unit}"


def as_json(target: str | Path | None, content: Any, overwrite: bool) -> bool:
    """Write a command's result where ``--json`` says; True where it took standard output, which is then its alone."""
    if target is None:
        return False
    write_json(target, content, overwrite)
    return str(target) == STDOUT


@contextmanager
def spoken(target: str | Path | None) -> Iterator[None]:
    """What is said and shown meanwhile goes to standard error where ``--json`` takes standard output."""
    with redirect_stdout(sys.stderr) if str(target) == STDOUT else nullcontext():
        yield


def _plain(content: Any) -> Any:
    """What JSON can say: paths as text, NumPy's numbers as numbers, and null for a figure that there is not."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if hasattr(content, "tolist"):
        return _plain(content.tolist())
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return str(content) if isinstance(content, Path) else content


def write_json(target: str | Path, content: Any, overwrite: bool) -> None:
    """Write JSON to a file, or to standard output for ``-``."""
    text = json.dumps(_plain(content), indent=1, ensure_ascii=False, allow_nan=False)
    if str(target) == STDOUT:
        print(text, flush=True)
    else:
        write_text(target, text + "\n", overwrite)


def said_in(path: Path, key: str) -> Any:
    """What a JSON file says under a key; None where there is no such file, or it says nothing of it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))[key]
    except (OSError, ValueError, LookupError, TypeError):
        return None


def write_text(path: str | Path, text: str, overwrite: bool) -> None:
    """Write a file that the user named, whole or not at all; its folder must exist."""
    from station.runs.files import new_file

    with new_file(path, overwrite) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def progress(what: str) -> Iterator[Any]:
    """A progress bar on standard error; yields ``update(fraction, text="")``, fraction None where unknown; with the
    time that has passed and, where the fraction is known, the time still to go.

    Silent when not a terminal.
    """
    if not sys.stderr.isatty():
        yield lambda fraction, text="": None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    with Progress(TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn(),
                  TextColumn("still"), TimeRemainingColumn(),
                  console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(what, total=1.0)

        def update(fraction: float | None, text: str = "") -> None:
            bars.update(task, total=None if fraction is None else 1.0, completed=fraction,
                        description=printable(text) or what)

        yield update
