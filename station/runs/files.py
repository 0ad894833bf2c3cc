"""Opening and making run files: limits, and an output that is whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from station.errors import WorkError

MAX_FILE_BYTES = 2 << 30


def check_input(path: str | os.PathLike[str]) -> Path:
    """The path of a readable regular file within the size limit; WorkError in one line otherwise."""
    path = Path(path)
    try:
        if not path.is_file():
            raise WorkError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
        size = path.stat().st_size
        with path.open("rb"):
            pass
    except (OSError, ValueError) as error:
        raise WorkError(f"{path}: cannot be read ({reason(error)})") from None
    if size == 0:
        raise WorkError(f"{path}: the file is empty")
    if size > MAX_FILE_BYTES:
        raise WorkError(f"{path}: {size} bytes, at most {MAX_FILE_BYTES}")
    return path


def check_output(path: str | os.PathLike[str], overwrite: bool = False) -> Path:
    """The path of an output; WorkError where the folder is missing or a file is in the way."""
    path = Path(path)
    if not path.parent.is_dir():
        raise WorkError(f"{path}: the folder {path.parent} does not exist")
    if path.is_dir():
        raise WorkError(f"{path}: is a folder")
    if path.exists() and not overwrite:
        raise WorkError(f"{path}: exists already; choose another name or remove it")
    return path


@contextmanager
def new_file(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Give a path beside the output to write to; move it into place at the end, remove it after a failure.

    Without ``overwrite`` a file that has come into its place meanwhile stays, too.
    """
    path = check_output(path, overwrite)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path) if overwrite else _move_to_free(part, path)
    except OSError as error:
        raise WorkError(f"{path}: cannot be written ({reason(error)})") from None
    finally:
        part.unlink(missing_ok=True)


def _move_to_free(part: Path, path: Path) -> None:
    """Move a file to where none is; WorkError where one has come."""
    try:
        path.open("xb").close()     # none but this one has the place from here on
    except FileExistsError:
        raise WorkError(f"{path}: has come there meanwhile, and is not replaced; name another file") from None
    try:
        os.replace(part, path)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def reason(error: Exception) -> str:
    """The operating system's own words for a failure, without the path."""
    return getattr(error, "strerror", None) or str(error)
