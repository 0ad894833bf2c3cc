"""`station run KIND`: one test on a device, logged.  Each kind of test is a command, made from its reference."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from station.cli.options import (
    AnswerTicks,
    Baud,
    Force,
    Json,
    Overwrite,
    Port,
    RigName,
    RunFile,
    command,
    need_folder,
    need_outputs,
)
from station.cli.terminal import as_json, note, number, progress, say, spoken
from station.control.named import OPEN
from station.errors import StationError, UsageError

if TYPE_CHECKING:
    import numpy as np

    from station.device.port import Port as SerialPort
    from station.loop.run_test import LoopResult
    from station.loop.sink import LogSink
    from station.rig import Rig
    from station.runs.run import RunMetadata
    from station.view.live import LiveView

app = typer.Typer()
group = typer.Typer(no_args_is_help=False)
PANEL = "Devices"

KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "step": ("A step of the reference after a rest.", {"amplitude": 100.0, "duration": 2.0, "rest": 0.2}),
    "pulse": ("A pulse up and a pulse down; by default commands, open loop.",
              {"amplitude": 100.0, "width": 0.1, "duration": 2.0, "rest": 0.2, "second": None}),
    "pulse_train": ("Pulses up and down by turns; by default commands, open loop.",
                    {"amplitude": 100.0, "width": 0.1, "spacing": 0.5, "pulses": 6, "duration": 4.0, "rest": 0.2}),
    "triangle": ("A triangle wave.", {"amplitude": 100.0, "period": 1.0, "duration": 4.0, "rest": 0.2}),
    "sweep": ("A sine whose frequency rises.", {"amplitude": 50.0, "f0": 0.0, "f1": 40.0, "duration": 22.0,
                                                "rest": 1.0, "spacing": "linear"}),
    "multisine": ("Many sines at once, random phases.", {"amplitude": 50.0, "f0": 0.5, "f1": 25.0, "tones": 50,
                                                         "duration": 10.2, "rest": 0.2, "seed": 0}),
    "prbs": ("A binary sequence that holds all frequencies.", {"amplitude": 50.0, "hold": 0.02, "bits": 9,
                                                               "duration": 10.2, "rest": 0.2}),
    "chirp_burst": ("Bursts of a sine whose frequency rises, each left to ring out.", {
        "amplitude": 50.0, "f0": 0.5, "f1": 25.0, "length": 2.0, "pause": 1.0, "bursts": 3, "duration": 10.2,
        "rest": 0.2}),
}
"""Words and defaults of each kind, as in ``station.control.references`` (a test holds the two together)."""
WORDS = {
    "amplitude": "Size, counts.", "duration": "Length of the whole test, s, rests included.",
    "rest": "Rest before the test, s, at least 0.2.", "width": "Length of a pulse, s.",
    "second": "Where the second pulse begins, s.", "spacing": "From one pulse to the next, s.",
    "pulses": "How many pulses.", "period": "Period, s.", "f0": "First frequency, Hz.", "f1": "Last frequency, Hz.",
    "tones": "How many sines.", "seed": "Chooses the phases.", "hold": "Shortest time between switches, s.",
    "length": "Length of a burst, s.", "pause": "Rest after each burst, s.", "bursts": "How many bursts.",
    "bits": "Length of the sequence: 2^bits - 1.",
}
SWEEP_SPACING = "How the frequency rises: linear or log."

Controller = Annotated[str | None, typer.Option("--controller", metavar="NAME", help=(
    "open, p, lead or lead-accel, or a TOML file with kind, gain, ... By default open for pulses, else p."))]
Gain = Annotated[float | None, typer.Option("--gain", help="The controller's gain in place of its own.")]
Zero = Annotated[float | None, typer.Option("--zero", help="The lead's zero, rad/s, in place of its own.")]
Pole = Annotated[float | None, typer.Option("--pole", help="The lead's pole, rad/s, in place of its own.")]
RealTime = Annotated[bool, typer.Option("--realtime", help=(
    "Ask the system for a loop that is not disturbed; what was granted is told and logged."))]
Tags = Annotated[list[str] | None, typer.Option("--tag", metavar="TAG", help="Tag for the run; may be repeated.")]
Note = Annotated[str | None, typer.Option("--note", metavar="TEXT", help="Note for the run.")]
View = Annotated[bool, typer.Option("--view", help="Follow the test in Rerun's viewer, on this machine alone.")]
Log = Annotated[Path, typer.Option("--out", metavar="FILE", help="Where the run is logged (.mcap).")]


def perform(line: SerialPort, rig: Rig, controller: dict[str, Any], test: dict[str, Any],
            sink: Callable[[RunMetadata], LogSink], reference: np.ndarray | None = None, **settings: Any) -> LoopResult:
    """Run one test on the device at an open port, logged to ``sink``; ``settings`` go to ``run_test``.

    ``reference`` (counts) where the test's dictionary does not make it.  The abort key is heard meanwhile.
    """
    from station.cli import motor_driven
    from station.cli.keys import WORDS as KEYS
    from station.cli.keys import abort_key
    from station.control.compensators import Compensator
    from station.control.references import reference_from_test
    from station.loop.run_test import run_test

    compensator = Compensator.from_spec(controller, rig.sample_rate, rig.command_limit)
    if reference is None:
        reference = reference_from_test(test, rig.sample_rate)
    abort = threading.Event()
    what = f"{test['kind']} on {line.url}"
    with motor_driven(), abort_key(abort.set) as heard, progress(f"{what}; {KEYS}" if heard else what) as update:
        return run_test(line, rig, compensator, reference, log_sink=sink, abort=abort,
                        progress=lambda row, rows: update(row / rows), **{"metadata": {"test": test}, **settings})


def log_sink(out: Path, overwrite: bool = False, shown: Callable[[], LiveView] | None = None,
             ) -> Callable[[RunMetadata], LogSink]:
    """Makes the log at ``out``, with a live view beside it where one is to be shown."""
    from station.runs import McapLogWriter

    def make(metadata: RunMetadata) -> LogSink:
        log = McapLogWriter(out, metadata, overwrite=overwrite)
        if shown is None:
            return log
        from station.view.live import LogAndView

        return LogAndView(log, shown(), note)

    return make


def live_view(rig: Rig) -> Callable[[], LiveView]:
    """Makes live views that share one viewer, started at the first."""
    from station.view.live import shared_view

    return shared_view(rig)


def summary(result: LoopResult, out: Path) -> str:
    """How a test went, in a few lines: what was counted, how fast samples were answered, what was cut."""
    counts, latency = result.counts, result.latency
    bad = {"lost": counts.lost, "reordered": counts.reordered, "duplicated": counts.duplicated,
           "corrupt": counts.corrupt, "late": counts.late, "without command": counts.unanswered}
    trouble = ", ".join(f"{value} {name}" for name, value in bad.items() if value > 0) or "nothing lost or late"
    virtual = " of virtual time" if result.identity.virtual_time else ""
    lines = [f"{out}: {counts.samples} samples in {number(result.seconds)} s{f' ({duration(result)} s{virtual})'}; "
             f"{trouble}",
             "answer after " + ", ".join(f"{number(1e6 * value)} us ({name})" for name, value in (
                 ("median", latency.median), ("99 %", latency.p99), ("99.9 %", latency.p999),
                 ("longest", latency.max))) + f"; {number(100.0 * late_share(result))} % of the ticks had no command"]
    lines += [f"  {line}" for line in result.histogram.lines()]
    if result.clipped:
        lines.append(f"the command was cut to {number(result.metadata.entries()['command_limit'])} counts on "
                     f"{result.clipped} rows: what acted is smaller than what was asked")
    if result.metadata.entries().get("check") == "forced":
        lines.append("run without a passed check of this device and rig (--force); the log says so")
    if result.sample_path != "python":
        lines.append(f"sample path: {result.sample_path}")
    if result.realtime is not None:
        lines.append(result.realtime.words())
    return "\n".join(lines)


def counted(result: LoopResult, out: Path) -> dict[str, Any]:
    """The same for programs; times in s, counts as in the log's metadata."""
    entries = result.metadata.entries()
    return {"file": out, "run": out.stem, "rows": result.counts.samples, "sample_rate": entries["rig"]["sample_rate"],
            "test": result.metadata.test, "controller": result.metadata.controller, "seconds": result.seconds,
            "virtual_time": result.identity.virtual_time, "counts": asdict(result.counts),
            "latency": result.latency.as_dict(), "histogram": result.histogram.as_dict(),
            "without_command": late_share(result), "clipped_rows": result.clipped, "check": entries.get("check"),
            "sample_path": result.sample_path,
            "realtime": None if result.realtime is None else result.realtime.words()}


def duration(result: LoopResult) -> str:
    """Seconds of device time that a test took."""
    return number(result.counts.samples / float(result.metadata.entries()["rig"]["sample_rate"]))


def late_share(result: LoopResult) -> float:
    """Share of the recorded ticks that had no command in time."""
    return result.counts.unanswered / max(result.counts.samples, 1)


def need_log(out: Path) -> None:
    """Refuse a log of another form, or without a folder."""
    if out.suffix.lower() != ".mcap":
        raise UsageError(f"--out {out}: a run is logged as .mcap; `station export` makes other forms of it")
    need_folder(out)


def single(port: str, rig: str, out: Path, asked: dict[str, Any], reference: np.ndarray | None = None, *,
           controller: str | None, gain: float | None, zero: float | None, pole: float | None, overwrite: bool,
           view: bool, force: bool, realtime: bool, tags: list[str] | None, note_: str | None,
           baud: int | None, answer_ticks: int, json: str | None) -> None:
    """Run one test from the command line and say how it went."""
    from station.cli.controllers import controller_spec
    from station.device.port import open_port
    from station.rig import load_rig
    from station.runs.notes import require_tags

    need_log(out)
    require_tags(tags or [])
    need_outputs(out, json, overwrite=overwrite, inputs=[rig])
    model = load_rig(rig)
    spec = controller_spec(controller or ("open" if asked["kind"] in OPEN else "p"), model.sample_rate, gain=gain,
                           zero=zero, pole=pole)
    if spec.get("kind") == "lead_accel" and model.accelerometer is None:
        raise UsageError(f"--controller: rig {model.name} has no accelerometer")
    metadata = {"test": asked, **({"tags": sorted(set(tags))} if tags else {}), **({"note": note_} if note_ else {})}
    before = _written(out)
    sink = log_sink(out, overwrite, live_view(model) if view else None)
    with open_port(port, baud) as line:
        try:
            result = perform(line, model, spec, asked, sink, reference, metadata=metadata, force=force,
                             realtime=realtime, answer_ticks=answer_ticks)
        except (KeyboardInterrupt, StationError):
            if _written(out) not in (None, before):
                note(f"the rows so far are in {out}")
            raise
    if not as_json(json, counted(result, out), overwrite):
        say(summary(result, out))


def _written(path: Path) -> int | None:
    """When a file was last written to (ns); None where there is none."""
    return path.stat().st_mtime_ns if path.exists() else None


def _command_for(kind: str) -> Callable[..., None]:
    """The function behind `station run KIND`, its options those of the kind."""
    words, defaults = KINDS[kind]

    def run(port: Port, rig: RigName, out: Log, controller: Controller = None, gain: Gain = None, zero: Zero = None,
            pole: Pole = None, overwrite: Overwrite = False, view: View = False, force: Force = False,
            realtime: RealTime = False, tag: Tags = None, note: Note = None, baud: Baud = None,
            answer_ticks: AnswerTicks = 1, json: Json = None, **test: Any) -> None:
        asked = {"kind": kind, **{key: value for key, value in test.items() if value is not None}}
        single(port, rig, out, asked, controller=controller, gain=gain, zero=zero, pole=pole, overwrite=overwrite,
               view=view, force=force, realtime=realtime, tags=tag, note_=note, baud=baud, answer_ticks=answer_ticks,
               json=json)

    hints = {name: hint for name, hint in inspect.get_annotations(run, eval_str=True).items() if name != "test"}
    common = [parameter.replace(annotation=hints[parameter.name])
              for parameter in inspect.signature(run).parameters.values() if parameter.name != "test"]
    own = []
    for name, value in defaults.items():
        help_ = SWEEP_SPACING if (kind, name) == ("sweep", "spacing") else WORDS[name]
        hints[name] = Annotated[float | None if value is None else type(value), typer.Option(f"--{name}", help=help_)]
        own.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value, annotation=hints[name]))
    run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in common] + own)
    run.__annotations__ = hints
    run.__doc__ = words
    return run


for _kind in KINDS:
    _name = _kind.replace("_", "-")
    command(group, _name, "Tests", f"station run {_name} --port sim://sflr --rig sflr --out {_name}.mcap")(
        _command_for(_kind))


@command(group, "recorded", "Tests", "station run recorded step.mcap --port sim://sflr --rig sflr --out again.mcap")
def recorded(
    run: RunFile, port: Port, rig: RigName, out: Log, controller: Controller = None, gain: Gain = None,
    zero: Zero = None, pole: Pole = None, overwrite: Overwrite = False, view: View = False, force: Force = False,
    realtime: RealTime = False, tag: Tags = None, note: Note = None, baud: Baud = None,
    answer_ticks: AnswerTicks = 1, json: Json = None,
) -> None:
    """The reference of a logged run once more; under --controller open its commands."""
    from station.loop.plan import recorded_reference
    from station.rig import load_rig

    need_log(out)
    reference, asked = recorded_reference(run, load_rig(rig).sample_rate, controller == "open")
    single(port, rig, out, asked, reference, controller=controller, gain=gain, zero=zero, pole=pole,
           overwrite=overwrite, view=view, force=force, realtime=realtime, tags=tag, note_=note, baud=baud,
           answer_ticks=answer_ticks, json=json)


@group.callback(invoke_without_command=True)
def _run(
    context: typer.Context,
    plan: Annotated[Path | None, typer.Option("--plan", metavar="FILE", help=(
        "Run the tests of a plan (TOML), in place of one KIND; the same command goes on where it stopped."))] = None,
    port: Annotated[str | None, typer.Option("--port", metavar="PORT", help="With --plan: as for a KIND.")] = None,
    rig: Annotated[str | None, typer.Option("--rig", metavar="RIG", help="With --plan: as for a KIND.")] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help=(
        "With --plan: folder of the runs."))] = None,
    force: Force = False, realtime: RealTime = False, view: View = False, baud: Baud = None, json: Json = None,
    overwrite: Overwrite = False,
) -> None:
    """Run one test on a device and log it, or a plan of tests; the motor is commanded to zero on every way out."""
    if context.invoked_subcommand is not None:
        if plan or port or rig or out or json:
            raise UsageError(f"options of a test stand behind its kind: station run {context.invoked_subcommand} ...")
        return
    if plan is None:
        raise UsageError("which test? station run KIND ..., or station run --plan FILE; station run --help lists them")
    for name, value in (("--port", port), ("--rig", rig), ("--out", out)):
        if value is None:
            raise UsageError(f"{name}: missing; a plan wants --port, --rig and --out")
    from station.cli.plan import run_plan
    from station.rig import load_rig

    need_outputs(json, overwrite=overwrite, inputs=[plan, rig])
    with spoken(json):
        found = run_plan(plan, port, load_rig(rig), out, force=force, realtime=realtime, view=view, baud=baud)
    as_json(json, found, overwrite)


app.add_typer(group, name="run", rich_help_panel=PANEL, epilog=(
    "Example: station run step --port sim://sflr --rig sflr --controller lead --out step.mcap"))
