"""Runs as MATLAB files (version 5): one numeric variable for each column, the metadata as JSON text."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import scipy.io

from station.errors import WorkError, printable
from station.runs.columns import BY_NAME, MAX_ROWS, REQUIRED, name_fault, own_names
from station.runs.files import check_input, new_file, reason
from station.runs.foreign import BEFOREHAND, run_from
from station.runs.run import Run, RunMetadata

_NUMERIC = {"double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"}
METADATA = "metadata"
SHORT, MOST = 20, 8
"""Letters of a name, and names, that a message shows."""
_HEADER_BYTES = 128
_COMPRESSED = 15
_MAX_VARIABLE_BYTES = 8 * MAX_ROWS + 4096


def read_mat(path: str | os.PathLike[str]) -> Run:
    """Read a run; WorkError, one line naming file and variable.  Objects, structs and cells are never read.

    A variable beyond those of a run that is not a column of numbers as long as theirs is left out, as text about the
    test is; where one of theirs is missing it may be meant, and is told.
    """
    path = check_input(path)
    label = str(path)
    try:
        _check_sizes(path)
        found = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
        names = dict(zip(found, own_names(found), strict=True))
        lengths = {names[name]: max(shape, default=0) for name, (shape, _) in found.items()}
        whole = set(BEFOREHAND) <= lengths.keys()
        for name in found:
            fault = _variable_fault(name, found)
            if not whole or names[name] in BY_NAME or name == METADATA:
                if fault:
                    raise WorkError(f"{label}: {fault}")
            elif fault or lengths[name] != lengths["t"]:
                del names[name]
        fault = name_fault((name for name in names.values() if name != METADATA), BEFOREHAND)
        if fault:
            raise WorkError(f"{label}: {fault}")
        values = scipy.io.loadmat(path, variable_names=list(names), chars_as_strings=True)
    except WorkError:
        raise
    except Exception as error:  # scipy's reader raises whatever its parts raise on a damaged file
        raise WorkError(f"{label}: not a readable MATLAB 5 file ({reason(error)[:120]})") from None
    columns = {name: np.ravel(values[variable]) for variable, name in names.items() if name != METADATA}
    metadata = RunMetadata.from_json(label, str(values[METADATA][0])) if METADATA in found else RunMetadata()
    return run_from(label, path.stem, columns, metadata)


def _variable_fault(name: str, found: Mapping[str, tuple[tuple[int, ...], str]]) -> str | None:
    """Say why a variable is neither a column of numbers nor the metadata, or None."""
    shape, kind = found[name]
    if name == METADATA:
        return None if kind == "char" and shape == (1,) else "metadata: one line of text is wanted"
    if kind not in _NUMERIC:
        unpack = f"; save('run.mat', '-struct', {name[:40]!r}, '-v7') writes its fields as variables"
        return f"variable {name[:40]!r} is a {kind}; {_wanted(found)}{unpack if kind == 'struct' else ''}"
    if len(shape) != 2 or min(shape) != 1 or max(shape) > MAX_ROWS:
        return (f"variable {name[:40]!r}: one column of at most {MAX_ROWS} numbers is wanted, not "
                f"{'x'.join(map(str, shape))}; {_wanted(found)}")
    return None


def _wanted(found: Iterable[str]) -> str:
    """Which variables a file must hold, and which it does."""
    return (f"wanted are the variables {', '.join(REQUIRED)}, each one column of numbers, found are "
            f"{printable(', '.join(name[:SHORT] for name in list(found)[:MOST]))}")


def _check_sizes(path: Path) -> None:
    """Refuse a variable whose compressed data would grow beyond what a column can need."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        order = "<" if header[-2:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            if length > size:
                raise WorkError(f"{path}: not a readable MATLAB 5 file (half a variable)")
            if kind != _COMPRESSED:
                file.seek(length, os.SEEK_CUR)
                continue
            inflate, grown = zlib.decompressobj(), 0
            data = file.read(length)
            while data:
                grown += len(inflate.decompress(data, 1 << 20))
                data = inflate.unconsumed_tail
                if grown > _MAX_VARIABLE_BYTES:
                    raise WorkError(f"{path}: a variable of more than {_MAX_VARIABLE_BYTES} bytes")


def write_mat(run: Run, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write a run; numbers are kept bit by bit, columns stand upright."""
    with new_file(Path(path), overwrite) as part, part.open("wb") as file:
        scipy.io.savemat(file, {**run.columns(), METADATA: run.metadata.to_json()},
                         do_compression=True, oned_as="column")
