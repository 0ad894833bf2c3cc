"""The model at work: simulate a run's test, compare runs with a rig, fit its constants, draw its responses."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from station.cli.files import written
from station.cli.options import (
    Json,
    Out,
    Overwrite,
    RigName,
    RunFiles,
    as_logged,
    command,
    load_runs,
    need_outputs,
    tell_compared,
    tell_lacks,
)
from station.cli.terminal import as_json, console, progress, quantity, row, say, table, write_text
from station.errors import UsageError

if TYPE_CHECKING:
    from rich.table import Table


app = typer.Typer()
PANEL = "Model and diagnosis"


@command(app, "simulate", PANEL, "station simulate --rig sflr --like step.mcap --out simulated.csv")
def simulate(rig: RigName, like: Annotated[Path, typer.Option("--like", metavar="RUN", help=(
                 "Run whose reference, controller and length are taken."))],
             out: Out, json: Json = None, overwrite: Overwrite = False) -> None:
    """Do the test of a logged run on a rig's model, and write what comes out as a run."""
    from station.api import simulate as simulated
    from station.rig import load_rig
    from station.runs import export_run, load_run

    model = load_rig(rig)
    run = load_run(like)
    tell_lacks(like, run)
    need_outputs(out, json, overwrite=overwrite, inputs=[like, rig])
    made = simulated(model, run, name=out.stem)
    export_run(made, out, overwrite=overwrite)
    if not as_json(json, written(out, made, like), overwrite):
        say(f"{out}: {len(made)} rows, the test of {like} on {model.name}")


@command(app, "compare", PANEL, "station compare --rig sflr step.mcap pulse.mcap")
def compare(runs: RunFiles, rig: RigName, json: Json = None, overwrite: Overwrite = False) -> None:
    """Simulate the tests of runs on a rig, and measure how far simulation and measurement are apart."""
    from station.diagnose.compare import compare as against
    from station.rig import load_rig

    need_outputs(json, overwrite=overwrite, inputs=[rig, *runs])
    model = load_rig(rig)
    measured = load_runs(runs, model)
    with progress("simulating the tests") as update:
        compared = against(model, as_logged(model, measured), update)
    tell_compared(runs, measured, compared)
    found = compared.measures
    if as_json(json, {"runs": found}, overwrite):
        return
    console().print(comparison_table(model.name, found))


SIDES = ("measured", "simulated")


def comparison_table(rig: str, found: list[dict[str, Any]]) -> Table:
    """Measures of each run, measured against simulated; the error is nrmse, in percent of the signal's spread."""
    shown = table(f"Error in % of the signal's spread; measured and simulated by {rig}", "run", "angle", "acceleration",
                  "overshoot measured", "simulated", "settling measured", "simulated")
    for item in found:
        error = [quantity(100.0 * item[channel]["nrmse"], "%", 3) if channel in item else "-"
                 for channel in ("encoder", "accel")]
        step = []
        if item["measured"]:
            step = [quantity(item[side]["overshoot_percent"], "%", 3) if item[side] else "-" for side in SIDES]
            step += [quantity(item[side]["settling_time"], "s", 3, none="never") if item[side] else "-"
                     for side in SIDES]
        row(shown, item["run"], *error, *(step or ["-"] * 4))
    return shown


@command(app, "fit", PANEL, "station fit --rig sflr step.mcap sweep.mcap --save-rig fitted.toml")
def fit(
    runs: RunFiles, rig: RigName,
    save_rig: Annotated[Path | None, typer.Option("--save-rig", metavar="FILE", help="Write the fitted rig.")] = None,
    hold: Annotated[list[str] | None, typer.Option("--hold", metavar="TABLE.KEY", help=(
        "Constant that stays as it is; may be repeated. By default beam.mass_per_length, of a rig without a beam "
        "motor.inertia: one common factor of all torques and inertias is invisible."))] = None,
    domain: Annotated[Literal["time", "frequency", "both"], typer.Option("--domain", help=(
        "Compare predictions with the runs, or frequency responses with the model's."))] = "time",
    starts: Annotated[int, typer.Option("--starts", min=1, max=100, help="Starting points of the search.")] = 4,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Fit a rig's constants to runs within their stated uncertainty, and say what the runs cannot determine."""
    from station.fit import fit as fit_rig
    from station.rig import load_rig

    need_outputs(save_rig, json, overwrite=overwrite, inputs=[rig, *runs])
    model = load_rig(rig)
    loaded = load_runs(runs, model)
    with progress("fitting") as update:
        found = fit_rig(model, loaded, hold, domain=domain, starts=starts,
                        progress=lambda text, share: update(share, text))
    if save_rig is not None:
        write_text(save_rig, found.rig.to_toml(), overwrite)
    if as_json(json, {"constants": [asdict(constant) for constant in found.constants],
                      "held": found.held, "flat": [str(direction) for direction in found.flat],
                      "warnings": found.warnings, "chi2": found.chi2, "chi2_nominal": found.chi2_nominal}, overwrite):
        return
    say(found.table())


@command(app, "bode", PANEL, "station bode --rig sflr --run sweep.mcap --out bode.svg")
def bode(
    rig: RigName,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Figure to write: .png, .svg or .pdf.")],
    run: Annotated[Path | None, typer.Option("--run", metavar="RUN", help=(
        "Run whose measured response and coherence are drawn as well; a sweep is best."))] = None,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Draw the frequency responses of a rig: finite elements, continuous beam, and a run's if one is given."""
    from station.rig import load_rig
    from station.runs import load_run
    from station.runs.files import new_file
    from station.view.bode import bode_figure, response_table, responses

    need_outputs(out, json, overwrite=overwrite, inputs=[rig, run])
    if out.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise UsageError(f"--out {out}: a figure's name ends in .png, .svg or .pdf")
    model, log = load_rig(rig), None if run is None else load_run(run)
    if run is not None and log is not None:
        tell_lacks(run, log)
    with new_file(out, overwrite) as part:
        bode_figure(model, log).savefig(part, format=out.suffix[1:].lower())
    if json is not None:
        found, measured, _ = responses(model, log)
        told = {name: response_table(response) for name, response in found.items()}
        told |= {} if measured is None else {"measured": response_table(measured)}
        if as_json(json, {"file": out, **told}, overwrite):
            return
    say(f"{out}: {rig}" + ("" if run is None else f" and {run}"))
