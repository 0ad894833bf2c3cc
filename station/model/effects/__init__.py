"""The catalogue: every effect that a rig file may hold and a diagnosis may name."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from station.errors import UsageError
from station.model.effects.base import Effect, ParameterInfo, Stage

__all__ = ["Effect", "ParameterInfo", "Stage", "catalogue", "effect_class"]


@cache
def _import_own() -> None:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")


def _named(base: type[Effect]) -> dict[str, type[Effect]]:
    found = {}
    for cls in base.__subclasses__():
        if cls.name:
            found[cls.name] = cls
        found.update(_named(cls))
    return found


def catalogue() -> dict[str, type[Effect]]:
    """All effects by name: those of this package and any subclass of Effect that has been imported."""
    _import_own()
    return dict(sorted(_named(Effect).items()))


def effect_class(name: str) -> type[Effect]:
    """The effect of that name; UsageError lists the known ones."""
    known = catalogue()
    if name not in known:
        raise UsageError(f"effects: {name!r} is not an effect; known are {', '.join(known)}")
    return known[name]
