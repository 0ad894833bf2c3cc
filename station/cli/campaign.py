"""Campaign: many diagnoses over all cores or a cluster, and what they say together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from station.cli.options import Json, Overwrite, command, need_outputs
from station.cli.terminal import as_json, console, note, number, progress, row, said_in, say, table, write_json
from station.errors import UsageError, WorkError

if TYPE_CHECKING:
    from station.campaign.outcome import Outcome, Task

app = typer.Typer()
PANEL = "Model and diagnosis"
SUMMARY, REPORT = "summary.json", "report.html"


@command(app, "campaign", PANEL, "station campaign plan.toml --out campaign")
def campaign(
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help=(
        "Plan file (TOML): its table blind draws simulated rigs with hidden effects, its tables logs name rigs and run "
        "files."))],
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help=(
        "Folder for the cases, summary.json and report.html; what it holds already is not done again."))],
    workers: Annotated[int | None, typer.Option("--workers", min=1, max=1024, metavar="N", help=(
        "Processes on this machine; by default one per core."))] = None,
    scheduler: Annotated[str | None, typer.Option("--scheduler", metavar="ADDRESS", help=(
        "Use the Dask cluster of this scheduler, tls://host:8786, instead of this machine. Whoever reaches a scheduler "
        "can run code on its workers."))] = None,
    tls_ca: Annotated[Path | None, typer.Option("--tls-ca", metavar="FILE", help=(
        "Authority that signed the cluster's certificates (PEM), for tls://."))] = None,
    tls_cert: Annotated[Path | None, typer.Option("--tls-cert", metavar="FILE", help=(
        "Certificate to show the scheduler (PEM), for tls://."))] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", metavar="FILE", help=(
        "Key of that certificate (PEM), for tls://."))] = None,
    effort: Annotated[Literal["quick", "full"] | None, typer.Option("--effort", help=(
        "As in station diagnose; stands above what the plan says."))] = None,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Diagnose many cases, each kept as it ends; after an interruption the same command goes on from there."""
    from station.campaign import cluster
    from station.campaign.plan import case, load_tasks
    from station.campaign.run import run_campaign
    from station.campaign.summary import summary
    from station.view.campaign import write_campaign

    there = None
    if scheduler is not None:
        cluster.need()
        there = cluster.Scheduler(scheduler, tls_ca, tls_cert, tls_key)
        if there.warning:
            note(f"warning: {there.warning}")
    elif any((tls_ca, tls_cert, tls_key)):
        raise UsageError("--tls-ca, --tls-cert, --tls-key: of use with --scheduler tls://... alone")
    need_outputs(json, overwrite=overwrite, inputs=[plan])
    tasks = load_tasks(plan, effort)
    _need_own(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkError(f"{out}: not a folder that can be made: {error.strerror or error}") from None
    with progress("starting") as update:
        told = _Told(len(tasks), update)
        try:
            results = run_campaign(tasks, case, out, workers=workers, scheduler=there, told=told.ended,
                                   begun=told.begun)
        except KeyboardInterrupt:
            note(f"{told.done} of {len(tasks)} cases are kept in {out}; the same command goes on from there")
            raise
    found = summary(results)
    write_json(out / SUMMARY, found, overwrite=True)
    write_campaign(found, out / REPORT, plan.name)
    if not as_json(json, found, overwrite):
        _show(found)
        say(f"{out / 'report.html'}, {out / 'summary.json'}")
    if results.failed:
        label, why = next(iter(results.failed.items()))
        raise WorkError(f"{len(results.failed)} of {len(tasks)} cases failed; {label}: {why}")


def _need_own(out: Path) -> None:
    """Refuse a folder with a summary or a report that no campaign made: they would be replaced."""
    from station.campaign.summary import SCHEMA

    for name in (SUMMARY, REPORT):
        if (out / name).exists() and said_in(out / SUMMARY, "schema") != SCHEMA:
            raise WorkError(f"{out / name}: no campaign made it, and none replaces it; name another --out")


class _Told:
    """Says on standard error how far the campaign is."""

    def __init__(self, cases: int, update: Any) -> None:
        self.cases, self.done, self.update = cases, 0, update

    def begun(self, there: int, left: int) -> None:
        self.done = there
        note(f"{self.cases} cases, {there} of them done before" if there else f"{self.cases} cases")

    def ended(self, task: Task, found: Outcome | str) -> None:
        self.done += 1
        note(f"{self.done}/{self.cases} {task.label}: {found if isinstance(found, str) else _said(found)}")
        self.update(self.done / self.cases, f"{self.done} of {self.cases} cases")


def _said(outcome: Outcome) -> str:
    from station.campaign.summary import title

    causes = ", ".join(f"{title(key)} {cause['probability']:.2f}"
                       for key, cause in zip(outcome.said, outcome.causes, strict=True))
    verdict = outcome.verdict.replace("_", " ")
    return f"{verdict}: {causes}" if causes else verdict


def _show(found: dict[str, Any]) -> None:
    """The shares and the gains as tables."""
    shares = {name: value for name, value in found["shares"].items() if value["of"]}
    if found["confusion"]["rows"]:
        shown = table("", "share of the cases", "", "95 % interval", "cases")
        for name, value in shares.items():
            row(shown, name, _percent(value["share"]), f"{_percent(value['low'])} to {_percent(value['high'])}",
                f"{value['count']} of {value['of']}")
        console().print(shown)
    stated = found["calibration"]["stated"]
    if stated["error"] is not None:
        say(f"calibration error {stated['error']:.3f} over {stated['statements']} stated probabilities")
    shown = table("", "medians on held-out runs", "cases", "angle error", "acceleration error", "explained", "s")
    for line in found["gains"]:
        row(shown, line["group"], line["cases"], *(
            f"{number(line[channel]['nrmse_before'])} > {number(line[channel]['nrmse_after'])}"
            for channel in ("encoder", "accel")), number(line["explained_fraction"]), number(line["seconds"]))
    if found["gains"]:
        console().print(shown)


def _percent(value: float) -> str:
    return f"{100.0 * value:.1f} %"
