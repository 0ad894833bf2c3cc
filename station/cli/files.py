"""Run files: import, export, list, rescue, and replay through their own compensator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from station.cli.options import Json, Out, Overwrite, RunFile, RunFiles, command, load_runs, need_folder, rig_of
from station.cli.terminal import console, number, one_line, row, say, table, write_json

if TYPE_CHECKING:
    from station.runs.run import Run

app = typer.Typer()
PANEL = "Runs"

RigOrNone = Annotated[str | None, typer.Option("--rig", metavar="RIG", help=(
    "Rig file (TOML) or built-in name; by default the one that the run itself holds."))]


@command(app, "import", PANEL, "station import step.csv --rig sflr --out step.mcap")
def import_(
    run: RunFile, out: Out, rig: RigOrNone = None,
    zero_id: Annotated[str | None, typer.Option("--zero-id", metavar="NAME", help=(
        "Runs with the same name share one encoder zero."))] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read a CSV, Parquet, MAT or tab-separated laboratory log and keep it as a run (.mcap)."""
    from station.rig import load_rig
    from station.runs import import_run

    need_folder(out)
    described = load_rig(rig).model_dump(exclude_none=True) if rig else None
    done = import_run(run, out, overwrite=overwrite, rig=described, zero_id=zero_id)
    say(_written(out, done, run))


@command(app, "export", PANEL, "station export step.mcap --out step.csv")
def export(run: RunFile, out: Out, overwrite: Overwrite = False) -> None:
    """Write a run as .csv, .parquet, .mat, .rrd (Rerun) or .mcap."""
    from station.runs import export_run, load_run

    need_folder(out)
    done = load_run(run)
    export_run(done, out, overwrite)
    say(_written(out, done, run))


def _written(out: Path, run: Run, source: Path) -> str:
    return f"{out}: {len(run)} rows at {run.sample_rate:g} Hz from {source}"


@command(app, "runs", PANEL, "station runs demo/runs")
def runs(folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder that holds run files.")] = Path("."),
         kind: Annotated[str | None, typer.Option("--test", metavar="KIND", help="Only this kind of test.")] = None,
         json: Json = None) -> None:
    """List the runs of a folder; a file that cannot be read is listed with the reason."""
    from station.runs import list_runs

    found = [item for item in list_runs(folder)
             if kind is None or (item.metadata is not None and item.metadata.test.get("kind") == kind)]
    if json:
        write_json(json, {"runs": [_listed(item) for item in found]})
        return
    shown = table("", "run", "test", "controller", "s", "Hz")
    for item in found:
        if item.metadata is None:
            row(shown, item.path.name, one_line(item.problem, 200), "", "", "")
            continue
        row(shown, item.path.name, item.metadata.test.get("kind", "-"), item.metadata.controller.get("kind", "-"),
            number(item.duration, 4), number(item.sample_rate, 4))
    if found:
        console().print(shown)
    else:
        say(f"{folder}: no runs")


def _listed(item: Any) -> dict[str, Any]:
    if item.metadata is None:
        return {"file": item.path.name, "problem": item.problem}
    return {"file": item.path.name, "run": item.name, "test": item.metadata.test, "rows": item.rows,
            "controller": item.metadata.controller, "sample_rate": item.sample_rate}


@command(app, "recover", PANEL, "station recover broken.mcap --out whole.mcap")
def recover(run: RunFile, out: Out) -> None:
    """Complete a log that was cut short into a copy that other programs open; the original stays as it is."""
    from station.runs import recover as rescue

    need_folder(out)
    found = rescue(run, out)
    state = f"the log ends early ({found.cut_short})" if found.cut_short else "the log was complete"
    say(f"{out}: {found.rows} rows; {state}")


@command(app, "replay", PANEL, "station replay step.mcap")
def replay(
    run: RunFiles, rig: RigOrNone = None,
    shaped: Annotated[bool, typer.Option("--shaped", help=(
        "Start from the logged reference after the accelerometer loop, where the log has it."))] = False,
    tolerance: Annotated[float, typer.Option("--tolerance", min=0.0, metavar="COUNTS", help=(
        "Difference that still counts as the same command."))] = 1e-3,
    json: Json = None,
) -> None:
    """Work out a run's commands again by its own compensator, and say where and why they are not the logged ones."""
    from station.rig import load_rig
    from station.runs import compare_replay

    results = []
    for path, item in zip(run, load_runs(run), strict=True):
        limit = (load_rig(rig) if rig is not None else rig_of(item, path)).amplifier.limit
        results.append((item, compare_replay(item, limit, shaped=shaped, tolerance=tolerance)))
    if json:
        write_json(json, {"runs": [
            {"run": item.name, "max_abs_difference": found.max_abs_difference, "row": found.row, "same": found.same,
             "rows_beyond": found.rows_beyond, "note": found.note} for item, found in results]})
        if json == "-":
            return
    for item, found in results:
        say(f"{item.name}: largest difference {number(found.max_abs_difference)} counts, row {found.row} of "
            f"{len(item)}; {found.note}")
