"""Diagnose: what the simulation gets wrong, why, and what is gained by putting it right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from station.cli.options import Json, Overwrite, RigName, RunFiles, command, load_runs, need_outputs
from station.cli.terminal import STDOUT, console, progress, say, write_json, write_text

if TYPE_CHECKING:
    from station.diagnose.result import DiagnosisResult

app = typer.Typer()
PANEL = "Model and diagnosis"


@command(app, "diagnose", PANEL, "station diagnose --rig sflr pulse.mcap step.mcap sweep.mcap --report report.html")
def diagnose(
    runs: RunFiles, rig: RigName, json: Json = None,
    report: Annotated[Path | None, typer.Option("--report", metavar="FILE", help=(
        "Write the report, one HTML page that needs no network."))] = None,
    save_rig: Annotated[Path | None, typer.Option("--save-rig", metavar="FILE", help=(
        "Write the extended rig, which is again a rig file."))] = None,
    effort: Annotated[Literal["quick", "full"], typer.Option("--effort", help=(
        "quick looks at fewer combinations."))] = "full",
    overwrite: Overwrite = False,
) -> None:
    """Name what the simulation gets wrong on these runs, how sure that is, and what to test next."""
    from station.diagnose import PREPARE
    from station.estimation.pool import SIZE, Pool

    Pool(SIZE, PREPARE)     # the others load theirs while this one does
    from station.diagnose.diagnose import diagnose as find
    from station.rig import load_rig
    from station.runs.store import file_hash
    from station.view.terminal import print_diagnosis

    need_outputs(json, report, save_rig, overwrite=overwrite, inputs=[rig, *runs])
    nominal = load_rig(rig)
    loaded = load_runs(runs, nominal)
    read = {run.name: file_hash(path) for run, path in zip(loaded, runs, strict=True)}
    with progress("diagnosing") as update:
        result = find(nominal, loaded, effort=effort, progress=lambda text, share: update(share, text))
    result = with_files(result, read)
    save(result, json=json, report=report, rig=save_rig, overwrite=overwrite)
    if json == STDOUT:
        return
    print_diagnosis(result, console(), rig)
    if save_rig is not None and not result.diagnosis.causes:
        say(f"{save_rig}: {nominal.name}, its constants re-fitted; no effect was added")


def with_files(result: DiagnosisResult, read: Mapping[str, str]) -> DiagnosisResult:
    """The result with the SHA-256 of every run's file as it was read, by which a reader finds the very runs again.

    ``read``: by the run's name; a run that came from no file keeps none.
    """
    runs = [row.model_copy(update={"file_sha256": read[row.run]}) if row.run in read else row
            for row in result.diagnosis.runs]
    return replace(result, diagnosis=result.diagnosis.model_copy(update={"runs": runs}))


def save(result: DiagnosisResult, *, json: Path | str | None, report: Path | None, rig: Path | None,
         overwrite: bool) -> None:
    """Write what was asked for."""
    if rig is not None:
        write_text(rig, result.extended_rig.to_toml(), overwrite)
    if json is not None:
        write_json(json, result.diagnosis.model_dump(mode="json", by_alias=True), overwrite)
    if report is not None:
        from station.view.report import write_report

        write_report(result, report, overwrite)
