"""Seeing runs: the Rerun viewer."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from station.cli.options import Overwrite, RunFiles, command, load_runs, need_outputs, rig_of, tell_unknown
from station.cli.terminal import say
from station.errors import UsageError

app = typer.Typer()


def status_names() -> dict[int, str]:
    """The device's words for the status bits that say that something went wrong."""
    from station.device.protocol import Status

    return {int(bit): bit.name.lower().replace("_", " ") for bit in Status
            if bit not in (Status.RUNNING, Status.MOVING)}


@command(app, "view", "Runs", "station view step.mcap sweep.mcap --rig sflr --save runs.rrd")
def view(
    runs: RunFiles,
    rig: Annotated[str | None, typer.Option("--rig", metavar="RIG", help=(
        "Rig that each run is simulated on; by default the one that the first run holds."))] = None,
    extended: Annotated[str | None, typer.Option("--extended", metavar="RIG", help=(
        "A second rig beside it: the one that `station diagnose --save-rig` wrote."))] = None,
    save: Annotated[Path | None, typer.Option("--save", metavar="FILE", help=(
        "Write a Rerun recording (.rrd) instead of opening the viewer."))] = None,
    web: Annotated[bool, typer.Option("--web", help="Open in the browser, served on 127.0.0.1 alone.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Draw runs in Rerun, each beside its simulation: angle, acceleration, command, residuals, events, frequency
    responses, and the arm of each moving, its deflection four times as large as it is.

    With --web the page is served by Station on 127.0.0.1 alone, under a policy by which the browser asks nobody else.
    """
    from station.rig import load_rig
    from station.view.recording import write_recording
    from station.view.viewer import view as open_viewer

    if save is not None and save.suffix.lower() != ".rrd":
        raise UsageError(f"--save {save}: a recording's name ends in .rrd")
    need_outputs(save, overwrite=overwrite, inputs=[rig, extended, *runs])
    loaded = load_runs(runs)
    tell_unknown(runs, loaded)
    model = load_rig(rig) if rig is not None else rig_of(loaded[0], runs[0])
    write = partial(write_recording, runs=loaded, rig=model, extended=None if extended is None else load_rig(extended),
                    status_names=status_names())
    if save is not None:
        write(save)
        say(f"{save}: {len(loaded)} runs")
        return
    with tempfile.TemporaryDirectory(prefix="station-") as folder:
        recording = Path(folder) / "runs.rrd"
        write(recording)
        open_viewer([recording], web=web)
