"""Whether logs are what they say: commands of the controller that they name, within what the amplifier gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from station.control.compensators import commanded
from station.diagnose.thresholds import OWN_COMMANDS
from station.errors import StationError
from station.model.simulate import limit_of
from station.rig import Rig
from station.runs.replay import replay_commands
from station.runs.run import Run


def as_logged(rig: Rig, runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """The runs, and a sentence for each thing that is not as it is said.

    A controller that is not the one that gave the commands is taken for unknown: closed again by it, a loop would do
    what no test did.
    """
    limit, said = rig.amplifier.limit, []
    beyond = {run.name: reached for run in runs if (reached := float(np.max(np.abs(run.command)))) > limit}
    shares = [off_by(rig, run) for run in runs]
    away = {run.name: share for run, share in zip(runs, shares, strict=True) if share > OWN_COMMANDS}
    if beyond:
        said.append(f"{_most(beyond)}: commands reach {max(beyond.values()):.4g} counts, and the rig file's "
                    f"amplifier.limit, {limit:.4g}, cuts what is simulated")
    if away:
        said.append(f"{_most(away)}: commands are not those of the controller that the log names (off by "
                    f"{100.0 * max(away.values()):.0f} % of their rms; station replay shows where), which is taken for "
                    "unknown")
    unknown = {"controller": {"kind": "unknown"}}
    return [replace(run, metadata=run.metadata.model_copy(update=unknown)) if share > OWN_COMMANDS else run
            for run, share in zip(runs, shares, strict=True)], said


def _most(shares: Mapping[str, float]) -> str:
    """The run of the largest, and how many others there are."""
    name = max(sorted(shares), key=shares.__getitem__)
    return name + (f" and {len(shares) - 1} more" if len(shares) > 1 else "")


def off_by(rig: Rig, run: Run) -> float:
    """By which share of their rms a run's commands are not its controller's; 0 where that cannot be worked out."""
    if run.open_loop or commanded(run.metadata.controller):
        return 0.0
    try:
        away = replay_commands(run, limit_of(rig, run.metadata)) - run.command
    except StationError:    # told where the loop is simulated
        return 0.0
    return float(np.linalg.norm(away)) / max(float(np.linalg.norm(run.command)), 1e-300)
