"""Run files: import and export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from station.cli.options import Out, Overwrite, RunFile, command
from station.cli.terminal import say

app = typer.Typer()
PANEL = "Runs"


@command(app, "import", PANEL, "station import step.txt --out step.mcap")
def import_(run: RunFile, out: Out, overwrite: Overwrite = False) -> None:
    """Read a CSV, Parquet, MAT or tab-separated laboratory log and keep it as a run (.mcap)."""
    _copy(run, out, overwrite)


@command(app, "export", PANEL, "station export step.mcap --out step.csv")
def export(run: RunFile, out: Out, overwrite: Overwrite = False) -> None:
    """Write a run as .csv, .parquet, .mat, .rrd (Rerun) or .mcap."""
    _copy(run, out, overwrite)


def _copy(source: Path, target: Path, overwrite: bool) -> None:
    from station.runs import export_run, load_run

    run = load_run(source)
    export_run(run, target, overwrite=overwrite)
    say(f"{target}: {len(run)} rows at {run.sample_rate:g} Hz from {source}")
