"""Runs: what a test on a device leaves behind, and its files.

The names below are loaded when first asked for: the model needs ``station.runs.run`` alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from station.runs.mcap_log import McapLogWriter
    from station.runs.notes import annotate
    from station.runs.replay import ReplayResult, compare_replay, replay_commands
    from station.runs.run import Run, RunMetadata
    from station.runs.store import (
        Recovery,
        RunFilter,
        RunSummary,
        export_run,
        import_run,
        list_runs,
        load_run,
        recover,
        trim,
    )

_HOMES = {
    "mcap_log": ("McapLogWriter",),
    "replay": ("ReplayResult", "compare_replay", "replay_commands"),
    "run": ("Run", "RunMetadata"),
    "notes": ("annotate",),
    "store": ("Recovery", "RunFilter", "RunSummary", "export_run", "import_run", "list_runs", "load_run", "recover",
              "trim"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["McapLogWriter", "Recovery", "ReplayResult", "Run", "RunFilter", "RunMetadata", "RunSummary", "annotate",
           "compare_replay", "export_run", "import_run", "list_runs", "load_run", "recover", "replay_commands", "trim"]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
