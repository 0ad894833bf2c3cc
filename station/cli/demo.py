"""`station demo`: the whole job on a simulated rig with a hidden effect, which is shown only at the end."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlencode

import typer

from station.cli.options import command
from station.cli.terminal import console, note, number, progress, row, say, table, write_text
from station.errors import WorkError

if TYPE_CHECKING:
    import numpy as np

    from station.diagnose.result import DiagnosisResult
    from station.model.effects import Effect
    from station.rig import Rig
    from station.runs.run import Run

app = typer.Typer()

NOMINAL = "sflr"
NOISE = 0.5
"""Accelerometer, counts, one sigma."""
TESTS: dict[str, tuple[str, dict[str, Any]]] = {
    "pulse": ("open", {"kind": "pulse", "amplitude": 100.0}),
    "pulse_small": ("open", {"kind": "pulse", "amplitude": 40.0, "width": 0.2}),
    "step_p": ("p", {"kind": "step", "amplitude": 50.0}),
    "step_lead": ("lead", {"kind": "step", "amplitude": 100.0}),
    "sweep": ("p", {"kind": "sweep", "amplitude": 50.0, "f1": 20.0, "duration": 8.0}),
}
"""Controller and test by name of the run."""
APART = ("step_apart", ("lead", {"kind": "step", "amplitude": -70.0}))
"""The run that the diagnosis never sees."""
MARK = "station-demo"
"""File that marks a folder as one that an earlier demo left, and this one may replace."""


@command(app, "demo", "Start here", "station demo --seed 7")
def demo(
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Repeat the draw of an earlier demo.")] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help=(
        "Folder for runs, rig, diagnosis, report and recording."))] = Path("demo"),
    realtime: Annotated[bool, typer.Option("--realtime", help=(
        "Pace the tests by the clock, as a real rig does; without it they run as fast as they can."))] = False,
) -> None:
    """Find a hidden effect on a simulated rig: test, compare, diagnose, extend the model, then open the seal."""
    import secrets

    import numpy as np

    from station.cli.hidden import Sealed, draw
    from station.rig import load_rig

    begun = time.perf_counter()
    seed = secrets.randbelow(1_000_000) if seed is None else seed
    nominal = load_rig(NOMINAL)
    folder = _fresh(out)
    with tempfile.TemporaryDirectory(prefix="station-") as hiding:
        rng = np.random.default_rng(seed)
        say(f"1. A hidden rig, seed {seed}: {NOMINAL} with constants drawn within their uncertainty, and one effect")
        with progress("compiling the stepper, drawing the rig"):
            sealed = Sealed.write(draw(nominal, _planned(nominal), NOISE, rng), Path(hiding) / "hidden_rig.toml")
        say(f"   drawn from the catalogue. Sealed; its file has SHA-256 {sealed.sha256[:16]}...")
        say()
        say("2. Tests through the serial protocol, the firmware core answering" + (", in real time" if realtime else ""))
        runs = _measure(nominal, sealed.path, folder / "runs", rng, realtime)
        apart = runs.pop(APART[0])
        say()
        say(f"3. Compared with the nominal {NOMINAL} (error in % of the signal's spread), and diagnosed")
        with progress("diagnosing") as update:
            result = _diagnose(nominal, list(runs.values()), update)
        _say_diagnosis(result)
        _save(result, runs, apart, folder)
        say()
        say("4. The gain on a run kept apart, which no fit has seen")
        _say_gain(nominal, result, apart)
        say()
        say("5. The seal is opened")
        hidden = sealed.open()
        shutil.copyfile(sealed.path, folder / "hidden_rig.toml")
    _say_truth(hidden.effects[0], result)
    say()
    say(f"{time.perf_counter() - begun:.0f} s. Look at {folder / 'report.html'}; repeat with `station demo --seed {seed}`.")


def _fresh(folder: Path) -> Path:
    """The folder, empty; only what an earlier demo left is taken away."""
    if folder.exists() and not folder.is_dir():
        raise WorkError(f"{folder}: is a file; name a folder with --out")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            raise WorkError(f"{folder}: holds files that no demo made; name another folder with --out")
        shutil.rmtree(folder)
    (folder / "runs").mkdir(parents=True)
    write_text(folder / MARK, "Made by `station demo`, which replaces this folder when it runs again.\n")
    return folder


def _planned(rig: Rig) -> list[Run]:
    """The tests as runs that have not happened: references, controllers, and the open loops' commands."""
    import numpy as np

    from station.cli.controllers import controller_spec
    from station.control.references import reference_from_test
    from station.runs.run import Run, RunMetadata

    planned = []
    for name, (controller, test) in TESTS.items():
        reference = reference_from_test(test, rig.sample_rate)
        still = np.zeros(len(reference))
        metadata = RunMetadata(controller=controller_spec(controller, rig.sample_rate), command_row=-1)
        planned.append(Run(name, np.arange(len(reference)) * rig.period, reference, reference, still, still, metadata))
    return planned


def _measure(nominal: Rig, hidden: Path, folder: Path, rng: np.random.Generator, realtime: bool) -> dict[str, Run]:
    """Run all tests on the hidden rig; each begins with the arm at rest at the encoder's zero."""
    from station.cli.controllers import controller_spec
    from station.cli.run import perform
    from station.device.port import open_port
    from station.runs import load_run

    shown = table("", "   run", "controller", "test", "counts", "samples", "lost, late")
    runs = {}
    for name, (controller, test) in {**TESTS, APART[0]: APART[1]}.items():
        options = {"rig": hidden, "noise": NOISE, "accel_offset": round(rng.uniform(-5.0, 5.0), 2),
                   "seed": int(rng.integers(2**31)), "speed": int(realtime)}
        out = folder / f"{name}.mcap"
        with open_port(f"sim://hidden?{urlencode(options)}") as line:
            result = perform(line, nominal, controller_spec(controller, nominal.sample_rate), test, out,
                             accel_zero=0.0, relative=False,
                             metadata={"test": test, "port": "sim://(sealed)", "zero_id": "demo"})
        counts = result.counts
        row(shown, f"   {name}", controller, test["kind"], number(test["amplitude"]), counts.samples,
            f"{counts.lost}, {counts.unanswered}")
        runs[name] = load_run(out)
    console().print(shown)
    return runs


def _diagnose(nominal: Rig, runs: list[Run], update: Any) -> DiagnosisResult:
    from station.diagnose import diagnose

    return diagnose(nominal, runs, progress=update)


def _say_diagnosis(result: DiagnosisResult) -> None:
    from station.cli.diagnosis import say_diagnosis

    say_diagnosis(result)


def _save(result: DiagnosisResult, runs: dict[str, Run], apart: Run, folder: Path) -> None:
    from station.cli.diagnosis import save_diagnosis

    save_diagnosis(result, json=folder / "diagnosis.json", report=folder / "report.html",
                   save_rig=folder / "extended_rig.toml")


def _say_gain(nominal: Rig, result: DiagnosisResult, apart: Run) -> None:
    """Errors on the run kept apart: nominal, re-fitted, extended."""


def _say_truth(effect: Effect, result: DiagnosisResult) -> None:
    """What was hidden, and whether the diagnosis was right; wrong is said as plainly as right."""
