"""`station demo`: the whole job on a simulated rig with a hidden effect, which is shown only at the end."""

from __future__ import annotations

import shutil
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import urlencode

import typer

from station.campaign.battery import NOISE, TESTS
from station.cli.options import command
from station.cli.terminal import console, number, progress, quantity, row, say, table, write_text
from station.errors import WorkError

if TYPE_CHECKING:
    import numpy as np

    from station.diagnose.result import Diagnosis, DiagnosisResult, RunComparison
    from station.model.effects import Effect
    from station.rig import Rig
    from station.runs.run import Run

app = typer.Typer()

NOMINAL = "sflr"
APART = ("step_apart", ("lead", {"kind": "step", "amplitude": -70.0}))
"""The run that the diagnosis never sees."""
MARK = "station-demo"
"""File that marks a folder as one that an earlier demo left, and where this one may replace what a demo makes."""
MADE = ("diagnosis.json", "report.html", "extended_rig.toml", "hidden_rig.toml", "recording.rrd",
        *(f"runs/{name}{ending}" for name in (*TESTS, APART[0]) for ending in (".mcap", ".rbl")))
"""What a demo makes in its folder."""


@command(app, "demo", "Start here", "station demo --seed 7")
def demo(
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Repeat the draw of an earlier demo.")] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help=(
        "Folder for runs, rig, diagnosis, report and recording."))] = Path("demo"),
    realtime: Annotated[bool, typer.Option("--realtime", help=(
        "Pace the tests by the clock, as a real rig does; without it they run as fast as they can."))] = False,
    effort: Annotated[Literal["quick", "full"], typer.Option("--effort", help="As in station diagnose.")] = "full",
) -> None:
    """Find a hidden effect on a simulated rig: test, compare, diagnose, extend the model, then open the seal."""
    import secrets

    import numpy as np

    from station.campaign.hidden import draw
    from station.campaign.simulated import planned
    from station.cli.diagnosis import save, with_files
    from station.cli.sealed import Sealed
    from station.cli.views import status_names
    from station.diagnose.diagnose import diagnose
    from station.rig import load_rig
    from station.runs.store import file_hash
    from station.view.recording import write_recording
    from station.view.terminal import print_diagnosis

    begun = time.perf_counter()
    seed = secrets.randbelow(1_000_000) if seed is None else seed
    nominal = load_rig(NOMINAL)
    folder = _fresh(out)
    with tempfile.TemporaryDirectory(prefix="station-") as hiding:
        rng = np.random.default_rng(seed)
        say(f"1. A hidden rig, seed {seed}: {NOMINAL} with constants drawn within their uncertainty, and one effect")
        with progress("compiling the stepper, drawing the rig"):
            sealed = Sealed.write(draw(nominal, planned(nominal), NOISE, rng), Path(hiding) / "hidden_rig.toml")
        say(f"   drawn from the catalogue. Sealed; the SHA-256 of its file is\n   {sealed.sha256}")
        say()
        say(f"2. Tests over the serial protocol, the firmware core answering{', in real time' if realtime else ''}")
        runs = _measure(nominal, sealed.path, folder / "runs", rng, realtime)
        apart = runs.pop(APART[0])
        say()
        say("3. Compared with the nominal rig and diagnosed, by five of these runs and the rig file alone")
        read = {name: file_hash(folder / "runs" / f"{name}.mcap") for name in runs}
        with progress("diagnosing") as update:
            result = diagnose(nominal, list(runs.values()), effort, progress=lambda text, share: update(share, text))
        result = with_files(result, read)
        save(result, json=folder / "diagnosis.json", report=folder / "report.html", rig=folder / "extended_rig.toml",
             overwrite=True)
        print_diagnosis(result, console())
        say()
        say("4. The gain on a run kept apart, which no fit has seen")
        comparison = _gain(result, apart)
        write_recording(folder / "recording.rrd", [*result.comparisons, comparison], nominal,
                        status_names=status_names())
        say()
        say("5. The seal is opened")
        hidden = sealed.open()
        shutil.copyfile(sealed.path, folder / "hidden_rig.toml")
    for line in told(hidden.effects[0], result.diagnosis):
        say(line)
    say()
    say(f"{time.perf_counter() - begun:.0f} s. Look at {folder / 'report.html'}; repeat this draw by --seed {seed}.")


def _fresh(folder: Path) -> Path:
    """The folder, without what an earlier demo made; what else a person has put there stays."""
    from station.runs.notes import set_notes_aside

    if folder.exists() and not folder.is_dir():
        raise WorkError(f"{folder}: is a file; name a folder with --out")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            raise WorkError(f"{folder}: holds files that no demo made; name another folder with --out")
        for name in MADE:
            (folder / name).unlink(missing_ok=True)
            set_notes_aside(folder / name)
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    write_text(folder / MARK, "Made by `station demo`, which replaces what it made here when it runs again.\n",
               overwrite=True)
    return folder


def _measure(nominal: Rig, hidden: Path, folder: Path, rng: np.random.Generator, realtime: bool) -> dict[str, Run]:
    """Run all tests on the hidden rig, each from where the one before left the arm."""
    from station.cli.controllers import controller_spec
    from station.cli.run import perform
    from station.device.port import open_port
    from station.runs import McapLogWriter, load_run

    shown = table("", "   run", "controller", "test", "counts", "samples", "lost, late")
    options = {"rig": hidden, "noise": NOISE, "accel_offset": round(rng.uniform(-5.0, 5.0), 2),
               "seed": int(rng.integers(2**31)), "speed": int(realtime)}
    runs = {}
    with open_port(f"sim://hidden?{urlencode(options)}") as line:
        for name, (controller, test) in {**TESTS, APART[0]: APART[1]}.items():
            out = folder / f"{name}.mcap"
            counts = perform(line, nominal, controller_spec(controller, nominal.sample_rate), test,
                             partial(McapLogWriter, out), metadata={"test": test, "port": "sim://(sealed)"}).counts
            row(shown, f"   {name}", controller, test["kind"], number(test["amplitude"]), counts.samples,
                f"{counts.lost}, {counts.unanswered}")
            runs[name] = load_run(out)
    console().print(shown)
    return runs


def _gain(result: DiagnosisResult, apart: Run) -> RunComparison:
    """Say the errors on the run kept apart: by the nominal rig, the re-fitted one, the extended one."""
    from station.diagnose.compare import compare
    from station.diagnose.measures import nrmse
    from station.diagnose.result import RunComparison

    before, refit, after = (compare(rig, [apart]).simulations[0]
                            for rig in (result.rig, result.refit_rig, result.extended_rig))
    shown = table("", f"   error on {apart.name}", "nominal", "re-fitted", "extended")
    for channel, name in (("encoder", "angle"), ("accel", "acceleration")):
        errors = (nrmse(getattr(apart, channel), getattr(made, channel)) for made in (before, refit, after))
        row(shown, f"   {name}", *(f"{100.0 * error:.1f} %" for error in errors))
    console().print(shown)
    return RunComparison(apart, before, refit, after)


def told(effect: Effect, diagnosis: Diagnosis | None) -> list[str]:
    """What was hidden, and whether the diagnosis, if there is one, was right: wrong as plainly as right."""
    from station.view.wording import cause_title, digits_of

    hidden, truth = cause_title(effect.name, effect.at), effect.values()
    units = {name: info.unit for name, info in effect.parameters().items()}
    lines = [f"   Hidden was: {hidden}, "
             + ", ".join(f"{name.replace('_', ' ')} {quantity(value, units[name])}" for name, value in truth.items())]
    if diagnosis is None:
        return lines
    named = [(cause.effect, cause.at) for cause in diagnosis.causes]
    rivals = [(rival.effect, rival.at) for cause in diagnosis.causes for rival in cause.rivals]
    place = (effect.name, effect.at)
    if place in named and named[0] == place and len(named) == 1:
        lines.append("   RIGHT: that is what was named, and nothing else.")
    elif place in named:
        others = ", ".join(cause_title(*other) for other in named if other != place)
        lines.append(f"   PARTLY RIGHT: it was named, but so was what is not there: {others}.")
    elif place in rivals:
        lines.append(f"   WRONG: {cause_title(*named[0])} was named; what was hidden is listed as a rival only.")
    elif named:
        lines.append(f"   WRONG: named was {', '.join(cause_title(*other) for other in named)}.")
    else:
        lines.append(f"   WRONG: nothing was named (verdict: {diagnosis.verdict.replace('_', ' ')}).")
    for cause in diagnosis.causes:
        if (cause.effect, cause.at) == place:
            for name, found in cause.parameters.items():
                above, below = truth[name] >= found.low, truth[name] <= found.high
                inside = (above and below) if found.low <= found.high else (above or below)     # an angle may wrap
                digits = max(digits_of(found), 4)
                lines.append(f"   {name.replace('_', ' ')}: {quantity(truth[name], found.unit, digits)} is "
                             f"{'inside' if inside else 'OUTSIDE'} the 95 % interval {number(found.low, digits)} to "
                             f"{number(found.high, digits)}.")
    return lines
