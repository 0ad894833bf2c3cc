"""Runs of one name in several folders, or in several forms: names by which results tell them apart."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from station.errors import UsageError
from station.runs.run import Run
from station.runs.store import load_run


def names_apart(files: Sequence[str | os.PathLike[str]]) -> list[str]:
    """A name for each file: its own without the ending; where others have that too, with the ending or with as many
    folders before it as tell them apart ("monday/step").  UsageError where one file is named twice.
    """
    paths = [Path(file) for file in files]
    whole = [path.resolve() for path in paths]
    for index, path in enumerate(whole):
        if path in whole[:index]:
            raise UsageError(f"{paths[index]}: named twice; each run counts once")
    names = [path.stem for path in paths]
    for name in {name for name in names if names.count(name) > 1}:
        alike = [index for index, path in enumerate(paths) if path.stem == name]
        for index, apart in zip(alike, _apart([whole[index] for index in alike]), strict=True):
            names[index] = apart
    return names


def _apart(paths: list[Path]) -> list[str]:
    for folders in range(max(len(path.parts) for path in paths)):
        for ending in (False, True):
            names = ["/".join([*path.parts[:-1][len(path.parts) - 1 - folders:], path.name if ending else path.stem])
                     for path in paths]
            if len(set(names)) == len(names):
                return names
    raise AssertionError("paths that differ have names that differ")


def load_runs(files: Sequence[str | os.PathLike[str]]) -> list[Run]:
    """Read run files under names that tell them apart; WorkError as ``load_run``, UsageError as ``names_apart``."""
    return [replace(load_run(file), name=name) for file, name in zip(files, names_apart(files), strict=True)]
