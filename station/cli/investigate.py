"""`station investigate`: test, diagnose, choose the next test, until the cause is decided or no test would help."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from station.cli.options import AnswerTicks, Baud, Force, Json, Overwrite, Port, RigName, command, need_outputs
from station.cli.terminal import as_json, console, note, progress, say, spoken
from station.errors import UsageError, WorkError

if TYPE_CHECKING:
    from station.diagnose.investigate import Investigation
    from station.diagnose.result import DiagnosisResult
    from station.rig import Rig
    from station.runs.run import Run

app = typer.Typer()
PANEL = "Model and diagnosis"
ENDS = {"decided": "Decided", "hopeless": "No further test would help", "budget": "The budget is spent"}


@command(app, "investigate", PANEL, "station investigate --port sim://sflr --rig sflr --out investigation")
def investigate(
    port: Port, rig: RigName,
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help=(
        "New folder for runs, diagnosis, report and extended rig."))],
    budget: Annotated[int, typer.Option("--budget", min=1, metavar="N", help="Most runs.")] = 8,
    first: Annotated[str | None, typer.Option("--first", metavar="TEST", help=(
        "First test, as KIND or KIND:KEY=VALUE,... (keys as in station run, controller too); by default the one that "
        "shows most of the catalogue."))] = None,
    effort: Annotated[Literal["quick", "full"], typer.Option("--effort", help="As in station diagnose.")] = "full",
    cap: Annotated[float | None, typer.Option("--cap", min=1.0, metavar="COUNTS", help=(
        "Largest amplitude of any test, besides what the rig's limits allow."))] = None,
    force: Force = False, baud: Baud = None, answer_ticks: AnswerTicks = 1, json: Json = None,
    overwrite: Overwrite = False,
) -> None:
    """Run tests, each chosen by what those before left open, until it is decided what the simulation gets wrong.

    The tests are run as `station run` does: the motor is commanded to zero on every way out.
    """
    from station.device.port import open_port
    from station.diagnose.diagnose import diagnose
    from station.diagnose.investigate import investigate as search
    from station.rig import load_rig
    from station.view.terminal import print_diagnosis

    need_outputs(json, overwrite=overwrite, inputs=[rig])
    model = load_rig(rig)
    asked = None if first is None else first_test(first, model)
    kept = Folder(out, model, cap, force, answer_ticks)

    def find(nominal: Rig, runs: list[Run]) -> DiagnosisResult:
        with progress(f"diagnosing {len(runs)} run{'s' if len(runs) > 1 else ''}") as update:
            return diagnose(nominal, runs, effort, lambda text, share: update(share, text))

    with spoken(json), open_port(port, baud) as line:
        kept.make()
        try:
            found = search(model, partial(kept.run, line), find, budget=budget, first=asked,
                           on_step=partial(_tell, kept))
        finally:
            kept.report()
    if as_json(json, kept.told(found), overwrite):
        return
    say()
    say(f"{ENDS[found.outcome or 'budget']}: {found.why}.")
    print_diagnosis(found.result, console(), rig)
    say(f"{len(found.steps)} runs in {out / 'runs'}; look at {out / 'report.html'}")


def first_test(text: str, rig: Rig) -> dict[str, Any]:
    """A test from KIND:KEY=VALUE,...; UsageError names what is wrong with it."""
    from station.cli.controllers import controller_spec
    from station.cli.run import OPEN
    from station.control.references import defaults, reference_from_test

    kind, _, rest = text.partition(":")
    kind = kind.replace("-", "_")
    name = "open" if kind in OPEN else "p"
    test: dict[str, Any] = {"kind": kind}
    known = defaults(kind)
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if not equals:
            raise UsageError(f"--first {text}: {part!r} is no KEY=VALUE")
        if key == "controller":
            name = value
        elif isinstance(known.get(key), str):
            test[key] = value
        else:
            try:
                test[key] = float(value)
            except ValueError:
                raise UsageError(f"--first {text}: {key}: a number is wanted, not {value!r}") from None
    reference_from_test(test, rig.sample_rate)
    controller = controller_spec(name, rig.sample_rate)
    if controller.get("kind") == "lead_accel" and rig.accelerometer is None:
        raise UsageError(f"--first {text}: rig {rig.name} has no accelerometer")
    return {**test, "controller": controller}


def capped(test: dict[str, Any], open_loop: bool, rig: Rig, cap: float | None) -> dict[str, Any]:
    """The test with an amplitude (counts) within the cap and the rig's limits.

    In closed loop the reference stays so far within ``limits.travel`` that its overshoot (OVERSHOOT) does, too.
    """
    from station.diagnose.trials import OVERSHOOT

    size = test.get("amplitude")
    if not isinstance(size, int | float):
        return test
    bounds = [math.inf if cap is None else cap]
    if open_loop:
        bounds.append(rig.command_limit)
    elif rig.limits is not None and rig.limits.travel is not None:
        bounds.append(math.floor(rig.limits.travel / rig.angle_per_count / OVERSHOOT))
    allowed = min(bounds)
    return test if abs(size) <= allowed else {**test, "amplitude": math.copysign(allowed, size)}


class Folder:
    """What an investigation leaves: runs as they are made, and after each the diagnosis and the extended rig."""

    def __init__(self, path: Path, rig: Rig, cap: float | None = None, force: bool = False,
                 answer_ticks: int = 1) -> None:
        """Refuse a folder with files in it, before anything is run."""
        if path.exists() and not path.is_dir():
            raise WorkError(f"{path}: is a file; name a folder with --out")
        if path.is_dir() and any(path.iterdir()):
            raise WorkError(f"{path}: holds files already; name a new folder with --out")
        self.path, self.rig, self.cap, self.force, self.answer_ticks = path, rig, cap, force, answer_ticks
        self.made = 0
        self.found: DiagnosisResult | None = None
        self.files: dict[str, Path] = {}
        self.read: dict[str, str] = {}

    def make(self) -> None:
        """Create it."""
        (self.path / "runs").mkdir(parents=True, exist_ok=True)

    def run(self, line: Any, test: dict[str, Any], controller: dict[str, Any]) -> Run:
        """Run one test on the device at an open port, logged; what was logged stays whatever happens."""
        from station.cli.run import perform
        from station.runs import McapLogWriter, load_run
        from station.runs.store import file_hash

        test = capped(test, controller.get("kind") == "open", self.rig, self.cap)
        self.made += 1
        out = self.path / "runs" / f"{self.made:02d}-{test['kind']}-{controller['kind'].replace('_', '-')}.mcap"
        try:
            perform(line, self.rig, controller, test, partial(McapLogWriter, out), force=self.force,
                    answer_ticks=self.answer_ticks)
        except (KeyboardInterrupt, WorkError):
            if out.exists():
                note(f"the rows so far are in {out}")
            raise
        run = load_run(out)
        self.files[run.name], self.read[run.name] = out, file_hash(out)
        return run

    def keep(self, found: Investigation) -> None:
        """Write the last diagnosis and its rig."""
        from station.cli.diagnosis import save, with_files

        self.found = with_files(found.result, self.read)
        save(self.found, json=self.path / "diagnosis.json", report=None, rig=self.path / "extended_rig.toml",
             overwrite=True)

    def told(self, found: Investigation) -> dict[str, Any]:
        """For programs: how it ended, the runs and the verdict after each, the last diagnosis."""
        assert self.found is not None
        return {"outcome": found.outcome or "budget", "why": found.why,
                "runs": [{"file": self.files[step.run.name], "test": step.run.metadata.test, "why": step.why,
                          "verdict": step.result.diagnosis.verdict} for step in found.steps],
                "diagnosis": self.found.diagnosis.model_dump(mode="json", by_alias=True)}

    def report(self) -> None:
        """Write the report of the last diagnosis, where there is one."""
        if self.found is not None:
            from station.view.report import write_report

            write_report(self.found, self.path / "report.html")


def _tell(kept: Folder, found: Investigation) -> None:
    """Add the last run to the table on the terminal."""
    from station.view import wording

    kept.keep(found)
    step = found.steps[-1]
    said = step.result.diagnosis
    named = [f"{wording.cause_title(c.effect, c.at)} {wording.probability(c.probability)}" for c in said.causes]
    rivals = [f"{wording.cause_title(r.effect, r.at)} {wording.probability(r.probability)}"
              for c in said.causes[:1] for r in c.rivals[:2]]
    if len(found.steps) == 1:
        say(f"{'run':28s} {'verdict':18s} leading causes")
    say(f"{step.run.name:28s} {wording.VERDICTS[said.verdict]:18s} {', '.join(named) or 'none'}"
        + (f"; rivals {', '.join(rivals)}" if rivals else ""))
    if found.outcome is None and step.result.choice.plan.test is not None:
        test = step.result.choice.plan.test
        words = f"{test['kind'].replace('_', ' ')} {test['amplitude']:g} ({test['controller']['kind']})"
        say(f"    next: {words}: {step.result.choice.plan.why}")
