"""What notebooks and programs use: ``import station as st``, then ``st.load_run`` and so on; see docs/python.md.

Rigs are given as ``Rig``, as a built-in name or as a file; runs as ``Run`` or as a file.  Every failure is a
``StationError`` with one line: ``UsageError`` where the call is wrong, ``WorkError`` where files, lines or devices are.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from station import rig as rig_module
from station.control.compensators import Compensator
from station.control.named import NAMED, OPEN, SAMPLED_AT
from station.control.references import reference_from_test
from station.errors import UsageError
from station.rig import Rig
from station.runs.run import Run

if TYPE_CHECKING:
    from station.device.port import Port
    from station.diagnose.compare import Comparison
    from station.diagnose.result import DiagnosisResult

AnyRig = Rig | str | Path
AnyRun = Run | str | Path
Controller = str | Mapping[str, Any]


def run_test(port: str | Port, rig: AnyRig, test: Mapping[str, Any], controller: Controller | None = None, *,
             out: str | Path | None = None, overwrite: bool = False, metadata: Mapping[str, Any] | None = None,
             progress: Callable[[int, int], None] | None = None, abort: threading.Event | None = None,
             realtime: bool = False, force: bool = False, answer_ticks: int = 1) -> Run:
    """Run one test on the device at a port, as ``station run`` does; the run as it was logged.

    ``port``: a path, a pyserial URL, ``sim://sflr``, or a port that ``open_port`` gave, which stays open.  ``test``:
    {"kind": "step", "amplitude": 100.0, ...}, the keys those of ``station run KIND``.  ``controller``: open, p, lead,
    lead-accel or a dictionary; by default open for pulses, else p.  ``out``: the log (.mcap); without it the run is in
    memory alone.  ``progress(row, rows)`` is called about ten times a second.  The motor is commanded to zero on every
    way out; an interruption leaves the rows so far in ``out``.
    """
    from station.device.port import open_port
    from station.loop.run_test import run_test as run
    from station.runs.files import check_output
    from station.runs.mcap_log import McapLogWriter
    from station.runs.store import load_run

    model, asked = load_rig(rig), dict(test)
    spec = _controller(controller, asked, model)
    compensator = Compensator.from_spec(spec, model.sample_rate, model.command_limit)
    reference = reference_from_test(asked, model.sample_rate)
    if out is not None:
        if Path(out).suffix.lower() != ".mcap":
            raise UsageError(f"{out}: a run is logged as .mcap; export_run makes other forms of it")
        check_output(out, overwrite)
    with tempfile.TemporaryDirectory(prefix="station-") as folder:
        log = Path(folder) / f"{asked['kind']}.mcap" if out is None else Path(out)
        with open_port(port) if isinstance(port, str) else nullcontext(port) as line:
            run(line, model, compensator, reference, log_sink=partial(McapLogWriter, log, overwrite=overwrite),
                metadata={"test": asked, **(metadata or {})}, progress=progress, abort=abort, realtime=realtime,
                force=force, answer_ticks=answer_ticks)
        return load_run(log)


def simulate(rig: AnyRig, test: AnyRun | Mapping[str, Any], controller: Controller | None = None, *,
             name: str = "simulated") -> Run:
    """The test of a run (or a test as in ``run_test``), as the rig would have done it; no noise.

    A closed loop runs from the reference with its own compensator on the model's readings; ``controller`` puts another
    in its place.
    """
    from station.diagnose.trials import Trial
    from station.model.simulate import limit_of
    from station.model.simulate import simulate as model

    described = load_rig(rig)
    if isinstance(test, Mapping):
        run = Trial(dict(test), _controller(controller, test, described)).as_run(described)
    else:
        run = load_run(test).filled(described.sample_rate)
        if controller is not None:
            spec = _controller(controller, {}, described)
            run = replace(run, metadata=run.metadata.model_copy(update={"controller": spec}))
    made = model(described, run, accel_offset=run.metadata.accel_zero)
    metadata = run.metadata.model_copy(update={
        "rig": described.model_dump(exclude_none=True), "firmware": None, "session": None, "zero_id": None,
        "command_limit": limit_of(described, run.metadata), "simulated": True})
    return Run(name, run.t, made.reference, made.command, made.encoder, made.accel, metadata)


def compare(rig: AnyRig, runs: AnyRun | Sequence[AnyRun]) -> Comparison:
    """Runs beside a rig's simulation of the same tests, starting angle and accelerometer offset estimated per run."""
    from station.diagnose.compare import compare as against

    return against(load_rig(rig), _runs(runs))


def diagnose(rig: AnyRig, runs: AnyRun | Sequence[AnyRun], effort: Literal["quick", "full"] = "full",
             progress: Callable[[str, float], None] | None = None) -> DiagnosisResult:
    """What the simulation gets wrong, why, how sure that is, and the extended rig; ``progress(what, share)``."""
    from station.diagnose.diagnose import diagnose as find

    return find(load_rig(rig), _runs(runs), effort, progress)


@dataclass(frozen=True)
class Report:
    """The report of a diagnosis: one page of HTML that needs no network."""

    result: DiagnosisResult

    @property
    def html(self) -> str:
        """The page."""
        from station.view.report import report_html

        return report_html(self.result)

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the page, whole or not at all.  WorkError where a file is in the way or the folder is missing."""
        from station.runs.files import new_file

        with new_file(path, overwrite) as part:
            part.write_text(self.html, encoding="utf-8")
        return Path(path)

    def _repr_html_(self) -> str:
        return (f'<iframe title="Report" sandbox="allow-scripts" style="width:100%;height:720px;border:1px solid #999" '
                f'srcdoc="{escape(self.html, quote=True)}"></iframe>')


def load_rig(rig: AnyRig) -> Rig:
    """A rig by built-in name or from a TOML file; a ``Rig`` is itself.  UsageError where it is neither."""
    return rig if isinstance(rig, Rig) else rig_module.load_rig(rig)


def load_run(run: AnyRun) -> Run:
    """A run from a file (.mcap, .csv, .parquet, .mat, a laboratory's .txt); a ``Run`` is itself.  WorkError."""
    from station.runs.store import load_run as load

    return run if isinstance(run, Run) else load(run)


def _runs(runs: AnyRun | Sequence[AnyRun]) -> list[Run]:
    from station.runs.names import load_runs

    asked = [runs] if isinstance(runs, Run | str | Path) else list(runs)
    files = iter(load_runs([run for run in asked if not isinstance(run, Run)]))
    found = [run if isinstance(run, Run) else next(files) for run in asked]
    for name in {run.name for run in found}:
        if sum(run.name == name for run in found) > 1:
            raise UsageError(f"two runs are named {name}; results are told apart by name (dataclasses.replace)")
    return found


def _controller(asked: Controller | None, test: Mapping[str, Any], rig: Rig) -> dict[str, Any]:
    name = ("open" if test.get("kind") in OPEN else "p") if asked is None else asked
    if not isinstance(name, str):
        return dict(name)
    if name not in NAMED:
        raise UsageError(f"controller {name!r} is none of {', '.join(NAMED)}; or give a dictionary")
    if name == "lead-accel" and rig.sample_rate != SAMPLED_AT:
        raise UsageError(f"controller lead-accel: sampled at {SAMPLED_AT:g} Hz, the rig runs at {rig.sample_rate:g} Hz")
    return dict(NAMED[name])
