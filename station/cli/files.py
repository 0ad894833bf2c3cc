"""Run files: import, export, list, rescue, and replay through their own compensator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from station.cli.options import (
    Json,
    Out,
    Overwrite,
    RunFile,
    RunFiles,
    command,
    load_runs,
    need_outputs,
    rig_of,
    tell_lacks,
    tell_refused,
)
from station.cli.terminal import as_json, console, number, one_line, row, say, table
from station.cli.terminal import note as note_
from station.errors import UsageError

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
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Read a CSV, Parquet, MAT or tab-separated laboratory log and keep it as a run (.mcap)."""
    from station.rig import load_rig
    from station.runs import import_run

    need_outputs(out, json, overwrite=overwrite, inputs=[run, rig])
    described = load_rig(rig).model_dump(exclude_none=True) if rig else None
    done = import_run(run, out, overwrite=overwrite, rig=described, zero_id=zero_id)
    tell_lacks(run, done)
    tell_refused(run, done)
    _tell(json, out, done, run, overwrite)


@command(app, "export", PANEL, "station export step.mcap --out step.csv")
def export(run: RunFile, out: Out, json: Json = None, overwrite: Overwrite = False) -> None:
    """Write a run as .csv, .parquet, .mat, .rrd (Rerun) or .mcap."""
    from station.runs import export_run, load_run

    need_outputs(out, json, overwrite=overwrite, inputs=[run])
    done = load_run(run)
    tell_lacks(run, done)
    export_run(done, out, overwrite)
    _tell(json, out, done, run, overwrite)


def written(out: Path, run: Run, source: Path) -> dict[str, Any]:
    """What a program is told of a run file that was written."""
    return {"file": out, "source": source, "run": run.name, "rows": len(run), "sample_rate": run.sample_rate,
            "test": run.metadata.test, "controller": run.metadata.controller}


def _tell(json: str | None, out: Path, run: Run, source: Path, overwrite: bool) -> None:
    if not as_json(json, written(out, run, source), overwrite):
        say(f"{out}: {len(run)} rows at {run.sample_rate:g} Hz from {source}")


@command(app, "runs", PANEL, "station runs demo/runs --test step")
def runs(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder that holds run files.")] = Path("."),
    kind: Annotated[str | None, typer.Option("--test", metavar="KIND", help="Only this kind of test.")] = None,
    rig: Annotated[str | None, typer.Option("--rig", metavar="NAME", help="Only runs of the rig of this name.")] = None,
    controller: Annotated[str | None, typer.Option("--controller", metavar="KIND", help=(
        "Only under this kind of compensator: open, p, lead, lead_accel, ..."))] = None,
    since: Annotated[str | None, typer.Option("--since", metavar="DATE", help=(
        "Only from this date on, as 2026-03-31 (UTC)."))] = None,
    until: Annotated[str | None, typer.Option("--until", metavar="DATE", help="Only up to this date.")] = None,
    tag: Annotated[str | None, typer.Option("--tag", metavar="TAG", help="Only with this tag.")] = None,
    plan: Annotated[str | None, typer.Option("--plan", metavar="NAME", help="Only of the plan of this name.")] = None,
    html: Annotated[bool, typer.Option("--html", help=(
        "Write the list as a page, FOLDER/index.html, with thumbnails, step measures and links."))] = False,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """List the runs of a folder; a file that cannot be read is listed with the reason."""
    from station.runs import RunFilter, list_runs

    need_outputs(json, folder / "index.html" if html else None, overwrite=overwrite)
    wanted = RunFilter(rig, kind, controller, since, until, tag, plan)
    found = [item for item in list_runs(folder) if wanted.takes(item)]
    if html:
        from station.view.html import write_page
        from station.view.runs import PAGE, runs_html

        write_page(folder / PAGE, runs_html(folder, found), overwrite)
        note_(f"{folder / PAGE}: {len(found)} runs")
    if as_json(json, {"runs": [_listed(item) for item in found]}, overwrite):
        return
    shown = table("", "run", "test", "controller", "rig", "began", "s", "Hz", "tags", "remarks")
    for item in found:
        if item.metadata is None:
            row(shown, item.path.name, *[""] * 7, one_line(item.problem, 200))
            continue
        remarks = "; ".join(filter(None, [item.state and f"ended early: {item.state}", item.read_as, *item.notes]))
        row(shown, item.path.name, item.metadata.test.get("kind", "-"), item.metadata.controller.get("kind", "-"),
            item.rig or "-", item.began[:16].replace("T", " ") or "-", number(item.duration, 4),
            number(item.sample_rate, 4), ", ".join(item.tags), one_line(remarks, 120))
    if found:
        console().print(shown)
    else:
        say(f"{folder}: no runs" if wanted.wants_all else f"{folder}: no runs of this kind")


def _listed(item: Any) -> dict[str, Any]:
    if item.metadata is None:
        return {"file": item.path.name, "problem": item.problem}
    return {"file": item.path.name, "run": item.name, "test": item.metadata.test, "rows": item.rows,
            "controller": item.metadata.controller, "sample_rate": item.sample_rate, "rig": item.rig,
            "began": item.began, "tags": list(item.tags), "notes": list(item.notes), "ended_early": item.state}


@command(app, "note", PANEL, 'station note step.mcap "clamp tightened" --tag good')
def note(
    run: RunFile,
    text: Annotated[str | None, typer.Argument(metavar="TEXT", help="A note to add.")] = None,
    tag: Annotated[list[str] | None, typer.Option("--tag", metavar="TAG", help="Add a tag; may be repeated.")] = None,
    untag: Annotated[list[str] | None, typer.Option("--untag", metavar="TAG", help="Take a tag away.")] = None,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Add a note or tags to a run, or show those it has; they are kept beside its file."""
    from station.runs import annotate, load_run
    from station.runs.notes import notes_of, tags_of

    need_outputs(json, overwrite=overwrite, inputs=[run])
    metadata = load_run(run).metadata
    if text or tag or untag:
        annotate(run, tags=tag, without=untag, note=text)
    tags, notes = tags_of(run, metadata), notes_of(run, metadata)
    if as_json(json, {"file": run, "tags": list(tags), "notes": list(notes)}, overwrite):
        return
    say(f"{run}: tags: {', '.join(tags) or 'none'}")
    for said in notes:
        say(f"  {one_line(said)}")


@command(app, "trim", PANEL, "station trim step.mcap --to 1.5 --out short.mcap")
def trim(
    run: RunFile, out: Out,
    begin: Annotated[float | None, typer.Option("--from", metavar="S", help=(
        "First row's time, s; the arm must rest there. By default the beginning."))] = None,
    end: Annotated[float | None, typer.Option("--to", metavar="S", help=(
        "Last row's time, s; by default the end."))] = None,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Cut a run: the rows from one time to another, as a run of its own; the original stays as it is."""
    from station.runs import trim as cut

    need_outputs(out, json, overwrite=overwrite, inputs=[run])
    done = cut(run, out, begin, end, overwrite=overwrite)
    _tell(json, out, done, run, overwrite)


@command(app, "recover", PANEL, "station recover broken.mcap --out whole.mcap")
def recover(run: RunFile, out: Out, json: Json = None, overwrite: Overwrite = False) -> None:
    """Complete a log that was cut short into a copy that other programs open; the original stays as it is."""
    from station.runs import recover as rescue

    need_outputs(out, json, overwrite=overwrite, inputs=[run])
    found = rescue(run, out, overwrite=overwrite)
    if as_json(json, {"file": out, "source": run, "rows": found.rows, "cut_short": found.cut_short or None},
               overwrite):
        return
    state = f"the log ends early ({found.cut_short})" if found.cut_short else "the log was complete"
    say(f"{out}: {found.rows} rows; {state}")


@command(app, "replay", PANEL, "station replay step.mcap --model sflr")
def replay(
    run: RunFiles, rig: RigOrNone = None,
    model: Annotated[str | None, typer.Option("--model", metavar="RIG", help=(
        "Show the measured run against this rig's simulation: a rig file or built-in name."))] = None,
    controller: Annotated[str | None, typer.Option("--controller", metavar="NAME", help=(
        "Another compensator in place of the run's own: open, p, lead, lead-accel, or a TOML file."))] = None,
    save: Annotated[Path | None, typer.Option("--save", metavar="FILE", help=(
        "With --model: write measured and simulated as a Rerun recording (.rrd)."))] = None,
    shaped: Annotated[bool, typer.Option("--shaped", help=(
        "Start from the logged reference after the accelerometer loop, where the log has it."))] = False,
    tolerance: Annotated[float, typer.Option("--tolerance", min=0.0, metavar="COUNTS", help=(
        "Difference that still counts as the same command."))] = 1e-3,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Work out a run's commands again by its own compensator or another, and say where and why they are not the
    logged ones; with --model, how the simulated rig does the same test.
    """
    from dataclasses import replace as changed

    from station.cli.controllers import controller_spec
    from station.rig import load_rig
    from station.runs import compare_replay

    if save is not None and (model is None or save.suffix.lower() != ".rrd"):
        raise UsageError(f"--save {save}: a recording's name ends in .rrd, and --model says what is drawn beside a run")
    need_outputs(save, json, overwrite=overwrite, inputs=[model, rig, controller, *run])
    results = []
    for path, item in zip(run, load_runs(run), strict=True):
        limit = load_rig(rig).command_limit if rig is not None else _command_limit(item, path)
        if controller is not None:
            spec = controller_spec(controller, item.sample_rate)
            item = changed(item, metadata=item.metadata.model_copy(update={"controller": spec}))
        results.append((item, compare_replay(item, limit, shaped=shaped, tolerance=tolerance)))
    simulated = _simulated(model, [item for item, _ in results], save, overwrite) if model is not None else []
    if as_json(json, {"runs": [
            {"run": item.name, "max_abs_difference": found.max_abs_difference, "row": found.row, "same": found.same,
             "rows_beyond": found.rows_beyond, "note": found.note, **({"model": simulated[i]} if simulated else {})}
            for i, (item, found) in enumerate(results)]}, overwrite):
        return
    for i, (item, found) in enumerate(results):
        say(f"{item.name}: largest difference {number(found.max_abs_difference)} counts, row {found.row} of "
            f"{len(item)}; {found.note if controller is None else f'as {controller} would have had it'}")
        if simulated:
            say(f"  {model}: {_against(simulated[i])}")
    if save is not None:
        say(f"{save}: measured and simulated")


def _command_limit(run: Run, path: Path) -> float:
    """The limit under which a run was made, else that of its rig."""
    return run.metadata.command_limit or rig_of(run, path).command_limit


def _simulated(model: str, runs: list[Run], save: Path | None, overwrite: bool) -> list[dict[str, Any]]:
    """How a rig's simulation does the same tests; drawn beside the measured runs where that is asked for."""
    from station.cli.views import status_names
    from station.diagnose.compare import compare
    from station.rig import load_rig
    from station.view.recording import write_recording

    rig = load_rig(model)
    found = compare(rig, runs).measures
    if save is not None:
        write_recording(save, runs, rig, status_names=status_names(), overwrite=overwrite)
    return found


def _against(found: dict[str, Any]) -> str:
    fits = [f"{channel} fits by {100.0 * (1.0 - found[channel]['nrmse']):.1f} %" for channel in ("encoder", "accel")
            if channel in found]
    steps = [f"{key.replace('_', ' ')} {number(found['measured'][key])} measured, {number(value)} simulated"
             for key, value in found["simulated"].items()]
    return "; ".join([*fits, *steps])
