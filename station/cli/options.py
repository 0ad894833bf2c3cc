"""Options that several commands share, and their meaning."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from station.cli.terminal import note
from station.errors import UsageError, WorkError

if TYPE_CHECKING:
    from station.diagnose.compare import Comparison
    from station.rig import Rig
    from station.runs.run import Run

RigName = Annotated[str, typer.Option("--rig", metavar="RIG", help="Rig file (TOML), or a built-in name: sflr.")]
Port = Annotated[str, typer.Option("--port", metavar="PORT", help=(
    "Serial port: a path such as /dev/ttyUSB0 or COM3, any pyserial URL, sim://sflr (the simulated rig) or "
    "replay://FILE (a logged run)."))]
Baud = Annotated[int | None, typer.Option("--baud", min=300, metavar="RATE", help=(
    "Baud rate of a board behind a UART, in place of 921600; USB and sockets take no notice."))]
AnswerTicks = Annotated[int, typer.Option("--answer-ticks", min=1, max=4, metavar="N", help=(
    "Ticks from a sample to the command that answers it; more than 1 for a line that is slow for the rate."))]
Force = Annotated[bool, typer.Option("--force", help=(
    "Run a closed loop without a passed `station check` of this device and rig; the log says so."))]
RunFile = Annotated[Path, typer.Argument(metavar="RUN", help=(
    "Run file: .mcap, .csv, .parquet, .mat, or a laboratory's tab-separated .txt."))]
RunFiles = Annotated[list[Path], typer.Argument(metavar="RUN...", help=(
    "Run files: .mcap, .csv, .parquet, .mat, or a laboratory's tab-separated .txt."))]
Json = Annotated[str | None, typer.Option("--json", metavar="FILE", help=(
    "Write the result as JSON to FILE; - for standard output, where nothing else is then written."))]
Out = Annotated[Path, typer.Option("--out", metavar="FILE", help="File to write; its ending chooses the form.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the output file where it exists.")]


def command(app: typer.Typer, name: str, panel: str, example: str) -> Callable[[Callable], Callable]:
    """Register a command with its panel in the help and an example that runs as it stands."""
    return app.command(name, rich_help_panel=panel, epilog=f"Example: {example}", no_args_is_help=False)


def load_runs(paths: list[Path], rig: Rig | None = None) -> list[Run]:
    """Read run files, and say what they lack; runs of one name in two folders get names that tell them apart.

    WorkError where one's rate is not that of a ``rig`` on which they are to be simulated.
    """
    from station.runs.names import load_runs as load

    runs = load(paths)
    for path, run in zip(paths, runs, strict=True):
        tell_lacks(path, run)
        if rig is not None and (fault := run.rate_fault(rig.sample_rate)):
            raise WorkError(f"{path}: {fault}")
    return runs


def tell_lacks(path: Path, run: Run) -> None:
    """Say on standard error what a log lacks, and what reading made of it."""
    early = run.metadata.entries().get("cut_short")
    if early:
        note(f"{path}: the log ends early ({early}); the {len(run)} rows that it has are used")
    if run.read_as:
        note(f"{path}: {run.read_as}")
    if run.lost_samples:
        from station.runs.run import HELD

        note(f"{path}: {run.lost_samples} samples are missing; simulations run on through the gaps, and after one of "
             f"more than {HELD} fits find the state again, in rows that do not count")


def tell_refused(path: Path, run: Run) -> None:
    """Say on standard error where a log's controller is none that can be worked out again; the log keeps it."""
    from station.control.compensators import Compensator

    if run.loop_unknown:
        return
    try:
        Compensator.from_spec(run.metadata.controller, run.sample_rate, math.inf)
    except UsageError as error:
        note(f"{path}: metadata {error}; kept as it stands, but what works the loop out again will refuse it: mend it, "
             "or leave it out where the log's controller is none of the kinds")


NAME_IT = 'name the controller, in a CSV as # controller = {"kind": "p", "gain": 2.0} (kinds: docs/other_rig.md)'


def tell_unknown(paths: list[Path], runs: list[Run]) -> None:
    """Say on standard error which closed loops cannot be simulated, for nothing says what closed them."""
    for path, run in zip(paths, runs, strict=True):
        if run.loop_unknown:
            note(f"{path}: the log does not say what closed its loop, so its commands are followed as logged, not "
                 f"worked out from its reference, and the simulated angle drifts: its error says little; {NAME_IT}")


def as_logged(rig: Rig, runs: list[Run]) -> list[Run]:
    """The runs, those whose commands are not their controller's without it; say on standard error what is not as logs
    say."""
    from station.diagnose.logs import as_logged as taken

    found, said = taken(rig, [run.filled(rig.sample_rate) for run in runs])
    for sentence in said:
        note(sentence)
    return found


def tell_compared(paths: list[Path], runs: list[Run], compared: Comparison) -> None:
    """Say on standard error which closed loops are predicted a time ahead and not simulated."""
    for path, run, taken, ahead, why in zip(paths, runs, compared.runs, compared.seconds_ahead, compared.not_closed,
                                            strict=True):
        if ahead is not None:
            if taken.loop_unknown and not run.loop_unknown:
                why = "the log does not say rightly what closed its loop"
            note(f"{path}: {why}, so it is predicted {ahead:g} s ahead of what was read, by its logged commands, and "
                 f"not simulated as a whole{f'; {NAME_IT}' if run.loop_unknown else ''}")


def rig_of(run: Run, path: Path) -> Rig:
    """The rig that a run holds, or names among the built-in ones; a path in a run is never followed."""
    import tomli_w

    from station.rig import Rig, builtin_rigs

    known = run.metadata.rig
    try:
        text = tomli_w.dumps(known) if isinstance(known, dict) else builtin_rigs()[known]
        return Rig.from_toml(text, source=f"{path}: metadata rig")
    except (KeyError, TypeError, UsageError) as error:
        if isinstance(error, UsageError):
            raise WorkError(str(error)) from None
        raise UsageError(f"{path}: the run does not hold its rig; give --rig") from None


def need_folder(path: Path | str | None) -> None:
    """Refuse an output whose folder is missing, before any work is done."""
    if path is None or str(path) == "-":
        return
    path = Path(path)
    if not path.parent.is_dir():
        raise WorkError(f"{path}: the folder {path.parent} does not exist")
    if path.is_dir():
        raise WorkError(f"{path}: is a folder; name a file")


def need_outputs(*outputs: Path | str | None, overwrite: bool, inputs: Iterable[Path | str | None] = ()) -> None:
    """Refuse outputs before any work is done: without a folder, in the way of a file (``overwrite`` lets it be
    replaced), two of one name, or an input, which is never written to.
    """
    wanted = [Path(path) for path in outputs if path is not None and str(path) != "-"]
    sources = [Path(path) for path in inputs if path is not None]
    for index, path in enumerate(wanted):
        need_folder(path)
        if any(_same(path, source) for source in sources):
            raise UsageError(f"{path}: is an input of this command; name another file for what it writes")
        if any(_same(path, other) for other in wanted[:index]):
            raise UsageError(f"{path}: named for two outputs")
        if path.exists() and not overwrite:
            raise WorkError(f"{path}: exists already; --overwrite replaces it")


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return one.absolute() == other.absolute()
