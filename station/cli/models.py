"""The model at work: simulate a run's test, compare runs with a rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from station.cli.options import Json, Out, Overwrite, RigName, RunFile, RunFiles, command, load_runs, need_folder
from station.cli.terminal import console, note, number, progress, row, say, table, write_json

if TYPE_CHECKING:
    from station.rig import Rig
    from station.runs.run import Run

app = typer.Typer()
PANEL = "Model and diagnosis"


def simulated_run(rig: Rig, run: Run, name: str) -> Run:
    """The test of a run, as the rig would have done it."""
    from station.model.simulate import simulate

    made = simulate(rig, run, accel_offset=run.metadata.accel_zero)
    metadata = run.metadata.model_copy(update={
        "rig": rig.model_dump(exclude_none=True), "firmware": None, "session": None, "zero_id": None,
        "simulated": True})
    return replace(run.slice(0), name=name, metadata=metadata, reference=made.reference, command=made.command,
                   encoder=made.encoder, accel=made.accel, n=None, device_time=None, host_time=None, status=None,
                   command_sent=None, latency=None, slack=None, extra={})


@command(app, "simulate", PANEL, "station simulate --rig sflr --like step.mcap --out simulated.csv")
def simulate(rig: RigName, like: Annotated[Path, typer.Option("--like", metavar="RUN", help=(
                 "Run whose reference, controller and length are taken."))],
             out: Out, overwrite: Overwrite = False) -> None:
    """Do the test of a logged run on a rig's model, and write what comes out as a run."""
    from station.rig import load_rig
    from station.runs import export_run, load_run

    model = load_rig(rig)
    run = load_run(like)
    run.require_unbroken()
    need_folder(out)
    made = simulated_run(model, run, out.stem)
    export_run(made, out, overwrite=overwrite)
    say(f"{out}: {len(made)} rows, the test of {like} on {model.name}")
