"""Station: a microcontroller-in-the-loop control station that finds out what its simulation gets wrong.

``import station as st`` is quick; what stands below is loaded when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from station.api import Report, compare, diagnose, load_rig, load_run, run_test, simulate
    from station.control.compensators import Compensator
    from station.device.port import open_port
    from station.errors import StationError, UsageError, WorkError
    from station.model.effects import Effect, Stage, effect_class, load_effects
    from station.model.effects.base import parameter, torque_scale
    from station.rig import Rig
    from station.runs.quality import quality
    from station.runs.replay import compare_replay
    from station.runs.run import Run, RunMetadata
    from station.runs.store import export_run, import_run, list_runs
    from station.view.bode import bode_figure

__version__ = "0.1.0"

_HOMES = {
    "api": ("Report", "compare", "load_rig", "load_run", "run_test", "simulate"),
    "control.compensators": ("Compensator",),
    "device.port": ("open_port",),
    "errors": ("StationError", "UsageError", "WorkError"),
    "model.effects": ("Effect", "Stage", "effect_class", "load_effects"),
    "model.effects.base": ("parameter", "torque_scale"),
    "rig": ("Rig",),
    "runs.quality": ("quality",),
    "runs.replay": ("compare_replay",),
    "runs.run": ("Run", "RunMetadata"),
    "runs.store": ("export_run", "import_run", "list_runs"),
    "view.bode": ("bode_figure",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["Compensator", "Effect", "Report", "Rig", "Run", "RunMetadata", "Stage", "StationError", "UsageError",
           "WorkError", "bode_figure", "compare", "compare_replay", "diagnose", "effect_class", "export_run",
           "import_run", "list_runs", "load_effects", "load_rig", "load_run", "open_port", "parameter", "quality",
           "run_test", "simulate", "torque_scale"]


def __getattr__(name: str) -> Any:
    if name == "diagnose":                  # a package of that name, which can be called
        return import_module("station.diagnose")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
