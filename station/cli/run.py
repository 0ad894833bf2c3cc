"""`station run KIND`: one test on a device, logged.  Each kind of test is a command, made from its reference."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from station.cli.options import Overwrite, Port, RigName, command, need_folder
from station.cli.terminal import note, number, progress, say
from station.errors import StationError, UsageError

if TYPE_CHECKING:
    from station.device.port import Port as SerialPort
    from station.loop.run_test import LoopResult
    from station.loop.sink import LogSink
    from station.rig import Rig
    from station.runs.run import RunMetadata

app = typer.Typer()
group = typer.Typer(no_args_is_help=False)
PANEL = "Devices"

OPEN = frozenset({"pulse", "pulse_train"})
"""Kinds that run open loop where no controller is asked for; the others run under P control."""
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
}
"""Words and defaults of each kind, as in ``station.control.references`` (a test holds the two together)."""
WORDS = {
    "amplitude": "Size, counts.", "duration": "Length of the whole test, s, rests included.",
    "rest": "Rest before the test, s, at least 0.2.", "width": "Length of a pulse, s.",
    "second": "Where the second pulse begins, s.", "spacing": "From one pulse to the next, s.",
    "pulses": "How many pulses.", "period": "Period, s.", "f0": "First frequency, Hz.", "f1": "Last frequency, Hz.",
    "tones": "How many sines.", "seed": "Chooses the phases.", "hold": "Shortest time between switches, s.",
    "bits": "Length of the sequence: 2^bits - 1.",
}
SWEEP_SPACING = "How the frequency rises: linear or log."

Controller = Annotated[str | None, typer.Option("--controller", metavar="NAME", help=(
    "open, p, lead or lead-accel, or a TOML file with kind, gain, ... By default open for pulses, else p."))]
Gain = Annotated[float | None, typer.Option("--gain", help="The controller's gain in place of its own.")]
Zero = Annotated[float | None, typer.Option("--zero", help="The lead's zero, rad/s, in place of its own.")]
Pole = Annotated[float | None, typer.Option("--pole", help="The lead's pole, rad/s, in place of its own.")]
View = Annotated[bool, typer.Option("--view", help="Follow the test in Rerun's viewer, on this machine alone.")]
Log = Annotated[Path, typer.Option("--out", metavar="FILE", help="Where the run is logged (.mcap).")]


def perform(line: SerialPort, rig: Rig, controller: dict[str, Any], test: dict[str, Any],
            sink: Callable[[RunMetadata], LogSink], **settings: Any) -> LoopResult:
    """Run one test on the device at an open port, logged to ``sink``; ``settings`` go to ``run_test``."""
    from station.control.compensators import Compensator
    from station.control.references import reference_from_test
    from station.loop.run_test import run_test

    compensator = Compensator.from_spec(controller, rig.sample_rate, rig.amplifier.limit)
    reference = reference_from_test(test, rig.sample_rate)
    with progress(f"{test['kind']} on {line.url}") as update:
        return run_test(line, rig, compensator, reference, log_sink=sink,
                        progress=lambda row, rows: update(row / rows), **{"metadata": {"test": test}, **settings})


def _sink(out: Path, overwrite: bool, shown: Rig | None) -> Callable[[RunMetadata], LogSink]:
    """Makes the log at ``out``, with a live view beside it where a rig is to be shown."""
    from station.runs import McapLogWriter

    def make(metadata: RunMetadata) -> LogSink:
        log = McapLogWriter(out, metadata, overwrite=overwrite)
        if shown is None:
            return log
        from station.view.live import LiveView, LogAndView

        return LogAndView(log, LiveView(shown))

    return make


def summary(result: LoopResult, out: Path) -> str:
    """How a test went, in two lines."""
    counts, latency = result.counts, result.latency
    bad = {"lost": counts.lost, "duplicated": counts.duplicated, "corrupt": counts.corrupt, "late": counts.late,
           "without command": counts.unanswered}
    trouble = ", ".join(f"{value} {name}" for name, value in bad.items() if value > 0) or "nothing lost or late"
    return (f"{out}: {counts.samples} samples in {number(result.seconds)} s; {trouble}\n"
            f"answer after {number(1e6 * latency.median)} us (median), {number(1e6 * latency.p99)} us (99 %), "
            f"{number(1e6 * latency.max)} us (longest)")


def _command_for(kind: str) -> Callable[..., None]:
    """The function behind `station run KIND`, its options those of the kind."""
    words, defaults = KINDS[kind]

    def run(port: Port, rig: RigName, out: Log, controller: Controller = None, gain: Gain = None, zero: Zero = None,
            pole: Pole = None, overwrite: Overwrite = False, view: View = False, **test: Any) -> None:
        from station.cli.controllers import controller_spec
        from station.device.port import open_port
        from station.rig import load_rig

        if out.suffix.lower() != ".mcap":
            raise UsageError(f"--out {out}: a run is logged as .mcap; `station export` makes other forms of it")
        need_folder(out)
        model = load_rig(rig)
        spec = controller_spec(controller or ("open" if kind in OPEN else "p"), model.sample_rate, gain=gain,
                               zero=zero, pole=pole)
        asked = {"kind": kind, **{key: value for key, value in test.items() if value is not None}}
        if spec.get("kind") == "lead_accel" and model.accelerometer is None:
            raise UsageError(f"--controller: rig {model.name} has no accelerometer")
        before = out.exists()
        with open_port(port) as line:
            try:
                result = perform(line, model, spec, asked, _sink(out, overwrite, model if view else None))
            except (KeyboardInterrupt, StationError):
                if out.exists() and (overwrite or not before):
                    note(f"motor commanded to zero; the rows so far are in {out}")
                raise
        say(summary(result, out))

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


@group.callback()
def _run() -> None:
    """Run one test on a device and log it; the motor is commanded to zero on every way out."""


app.add_typer(group, name="run", rich_help_panel=PANEL, epilog=(
    "Example: station run step --port sim://sflr --rig sflr --controller lead --out step.mcap"))
