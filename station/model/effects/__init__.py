"""The catalogue: every effect that a rig file may hold and a diagnosis may name.

It holds the effects of this package, those that installed packages register under the entry point group
``station.effects``, those of the files that the environment variable STATION_EFFECTS names, and any other subclass of
Effect that has been imported.  A rig, run or plan file names effects and never brings them along.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import logging
import os
import pkgutil
import sys
import traceback
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from station.errors import UsageError
from station.model.effects.base import USUAL_SPEED, Effect, ParameterInfo, Stage, named

__all__ = ["FILES", "USUAL_SPEED", "Effect", "ParameterInfo", "Stage", "catalogue", "effect_class", "load_effects"]

GROUP = "station.effects"
"""Entry points of installed packages, each a module or a class of it."""
FILES = "STATION_EFFECTS"
"""Environment variable: Python files of a user's own, separated as in PATH; ``station --effects`` adds to it."""


@cache
def _import_own() -> None:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")


@cache
def _import_installed() -> None:
    """Load the entry points, once; one that fails is told in one line and leaves the others alone."""
    for point in sorted(entry_points(group=GROUP), key=lambda point: (point.name, point.value)):
        try:
            point.load()
        except (Exception, SystemExit) as error:
            logging.getLogger("station").warning(
                "station: effects of %s not loaded: %s", _owner(point), _reason(error))


def _owner(point: EntryPoint) -> str:
    package = point.dist.name if point.dist is not None else "an unknown package"
    return f"{package} (entry point {point.name} = {point.value})"


def _reason(error: BaseException, path: Path | None = None) -> str:
    """An error as one line, with the line of ``path`` at which it arose."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__)
             if path is not None and frame.filename == str(path)]
    if isinstance(error, SyntaxError) and path is not None and error.filename == str(path):
        lines = [error.lineno]
    text = " ".join(str(getattr(error, "msg", None) or error).split())
    return f"{f'line {lines[-1]}: ' if lines else ''}{type(error).__name__}: {text}"


def load_effects(path: str | Path) -> None:
    """Run a Python file of a user's own, once, so that its effects join the catalogue.

    UsageError: it cannot be read, does not run, or defines no effect.
    """
    _import_own()   # so that no file takes one of their names
    path = Path(path).expanduser().resolve()
    name = f"station_effects_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return
    try:
        spec = importlib.util.spec_from_file_location(name, path)
        if path.suffix != ".py" or spec is None or spec.loader is None:
            raise UsageError(f"effects: {path}: not a Python file (.py)")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        if not any(cls.__module__ == name for cls in named()):
            raise UsageError(f"effects: {path}: defines no effect, that is, no subclass of Effect with a name")
    except BaseException as error:
        sys.modules.pop(name, None)
        if isinstance(error, FileNotFoundError) and not path.exists():
            raise UsageError(f"effects: {path}: no such file") from None
        if isinstance(error, Exception | SystemExit) and not isinstance(error, UsageError):
            raise UsageError(f"effects: {path}: {_reason(error, path)}") from None
        raise


def catalogue() -> dict[str, type[Effect]]:
    """All effects by name; UsageError where a file of STATION_EFFECTS cannot be used."""
    _import_own()
    _import_installed()
    for path in os.environ.get(FILES, "").split(os.pathsep):
        if path:
            load_effects(path)
    return dict(sorted((cls.name, cls) for cls in named()))


def effect_class(name: str) -> type[Effect]:
    """The effect of that name; UsageError lists the known ones."""
    known = catalogue()
    if name not in known:
        raise UsageError(f"effects: {name!r} is not an effect (one of your own: station --effects FILE.py); "
                         f"known are {', '.join(known)}")
    return known[name]
