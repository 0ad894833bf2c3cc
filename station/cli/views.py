"""Seeing runs: the Rerun viewer, and a page of them beside their simulations."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from station.cli.options import (
    Json,
    Overwrite,
    RunFiles,
    as_logged,
    command,
    load_runs,
    need_outputs,
    rig_of,
    tell_compared,
    tell_unknown,
)
from station.cli.terminal import as_json, progress, say
from station.errors import UsageError

app = typer.Typer()
OneRig = Annotated[str | None, typer.Option("--rig", metavar="RIG", help=(
    "Rig that each run is simulated on; by default the one that the first run holds."))]
Extended = Annotated[str | None, typer.Option("--extended", metavar="RIG", help=(
    "A second rig beside it: the one that `station diagnose --save-rig` wrote."))]


def status_names() -> dict[int, str]:
    """The device's words for the status bits that say that something went wrong."""
    from station.device.protocol import Status

    return {int(bit): bit.name.lower().replace("_", " ") for bit in Status
            if bit not in (Status.RUNNING, Status.MOVING)}


@command(app, "view", "Runs", "station view step.mcap sweep.mcap --rig sflr --save runs.rrd")
def view(
    runs: RunFiles, rig: OneRig = None, extended: Extended = None,
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
        write(save, overwrite=overwrite)
        say(f"{save}: {len(loaded)} run{'' if len(loaded) == 1 else 's'}")
        return
    with tempfile.TemporaryDirectory(prefix="station-") as folder:
        recording = Path(folder) / "runs.rrd"
        write(recording)
        open_viewer([recording], web=web)


@command(app, "report", "Runs", "station report step.mcap --rig sflr --extended my_rig.toml --out report.html")
def report(
    runs: RunFiles,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Page to write (.html); it needs no network.")],
    rig: OneRig = None, extended: Extended = None, json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Write a page of runs beside their simulations: errors, the steps' overshoot, rise and settling, each run drawn.

    Nothing is fitted. That of a diagnosis is written by `station diagnose --report`.
    """
    from station.diagnose.compare import compare
    from station.rig import load_rig
    from station.runs.store import file_hash
    from station.view.beside import beside_html
    from station.view.html import write_page

    need_outputs(out, json, overwrite=overwrite, inputs=[rig, extended, *runs])
    if out.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"--out {out}: a page's name ends in .html")
    nominal = None if rig is None else load_rig(rig)
    loaded = load_runs(runs, nominal)
    models = {"rig of the run" if rig is None else Path(rig).name: nominal or rig_of(loaded[0], runs[0])}
    if extended is not None:
        name = Path(extended).name      # where a file lies is nobody's business on a page that is shared
        models[f"extended {name}" if name in models else name] = load_rig(extended)
    compared, taken = {}, as_logged(next(iter(models.values())), loaded)
    for name, model in models.items():
        with progress(f"simulating the tests by {name}") as update:
            compared[name] = compare(model, taken, update)
    tell_compared(runs, loaded, next(iter(compared.values())))
    write_page(out, beside_html(compared, [file_hash(path) for path in runs]), overwrite)
    if as_json(json, {"file": out, "simulated": {name: one.measures for name, one in compared.items()}},
               overwrite):
        return
    say(f"{out}: {len(loaded)} run{'' if len(loaded) == 1 else 's'}")
