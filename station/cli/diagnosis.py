"""Diagnose: what the simulation gets wrong, why, and what is gained by putting it right."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from station.cli.options import Json, RigName, RunFiles, command, load_runs, need_folder
from station.cli.terminal import console, number, progress, row, say, table, write_json, write_text

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
) -> None:
    """Name what the simulation gets wrong on these runs, how sure that is, and what to test next."""
    from station.diagnose import diagnose as find
    from station.rig import load_rig

    for path in (json, report, save_rig):
        need_folder(path)
    nominal = load_rig(rig)
    loaded = load_runs(runs)
    with progress("diagnosing") as update:
        result = find(nominal, loaded, effort=effort, progress=lambda text, share: update(share, text))
    save(result, json=json, report=report, rig=save_rig)
    if json != "-":
        say_result(result)


def save(result: DiagnosisResult, *, json: Path | str | None, report: Path | None, rig: Path | None) -> None:
    """Write what was asked for."""
    if rig is not None:
        write_text(rig, result.extended_rig.to_toml())
    if json is not None:
        write_json(json, result.diagnosis.model_dump(mode="json", by_alias=True))
    if report is not None:
        from station.view.report import write_report

        write_report(result, report)


def say_result(result: DiagnosisResult) -> None:
    """The diagnosis for a person: the verdict, what is wrong, the causes, the gain, what next."""
    from station.view import wording

    found = result.diagnosis
    say(wording.verdict_sentence(found, result.rig))
    if found.wrong:
        shown = table("Wrong", "run", "what", "simulated", "measured")
        for item in found.wrong[:8]:
            what, simulated, measured = wording.measure(item)
            row(shown, item.run, what, simulated, measured)
        console().print(shown)
    if found.causes:
        shown = table("Causes", "cause", "probability", "parameter", "value", "95 % interval", "rivals")
        for cause in found.causes:
            title, sure = wording.cause_title(cause.effect, cause.at), wording.probability(cause.probability)
            rivals = ", ".join(wording.cause_title(rival.effect, rival.at) for rival in cause.rivals[:2])
            for name, value in cause.parameters.items():
                row(shown, title, sure, name.replace("_", " "), f"{number(value.value)} {value.unit}",
                    f"{number(value.low)} to {number(value.high)}", rivals)
                title = sure = rivals = ""
        console().print(shown)
    gain = wording.gain_rows(found)
    if gain:
        words = ", ".join(f"{name} {wording.percent(channel.nrmse_before)} to {wording.percent(channel.nrmse_after)}"
                          for name, channel in gain)
        say(f"Error on runs left out of the fit: {words}"
            + ("" if found.gain.explained_fraction is None
               else f"; {wording.percent(found.gain.explained_fraction)} of what can be explained"))
    if found.next_experiment is not None:
        test = found.next_experiment.test
        say(f"Next: {wording.test_words(test) + ': ' if test else ''}{found.next_experiment.why}")
