"""From runs to causes.  The package can be called: ``station.diagnose(rig, runs)`` is
``station.api.diagnose``, whichever was imported first."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

PREPARE = "station.diagnose.diagnose:load_compiled"
"""For the ``Pool`` of a diagnosis: of that module, so that what it imports is loaded, too."""


class _Callable(ModuleType):
    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """As ``station.api.diagnose``."""
        return import_module("station.api").diagnose(*arguments, **options)


sys.modules[__name__].__class__ = _Callable
