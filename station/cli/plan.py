"""`station run --plan`: the tests of a plan, one after the other, resumed by the same command; and their table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from station.cli.controllers import controller_spec
from station.cli.run import live_view, log_sink, perform
from station.cli.terminal import console, note, number, row, said_in, say, table, write_json
from station.errors import StationError, UsageError, WorkError

if TYPE_CHECKING:
    from station.device.port import Port
    from station.loop.plan import Plan, Trial
    from station.rig import Rig
    from station.runs.run import Run

RESULTS = "results.json"
_FIGURES = {"overshoot": ("overshoot, %", 1.0), "rise": ("rise, s", 1.0), "settling": ("settling, s", 1.0),
            "final_error": ("final error", 1.0), "saturated": ("saturated, %", 100.0)}


def run_plan(path: Path, port: str, rig: Rig, out: Path, *, force: bool = False, realtime: bool = False,
             view: bool = False, baud: int | None = None) -> dict[str, Any]:
    """Run what is left of a plan, keep each run in ``out``, and say what all of them come to; the same for programs."""
    from station.device.port import open_port
    from station.loop.plan import load_plan

    plan = load_plan(path, rig, lambda name, folder: _controller(name, folder, rig))
    _make_folder(out)
    _need_own_table(plan, out / RESULTS)
    runs: dict[Trial, Run] = {}
    left: list[tuple[int, Trial]] = []
    for place, trial in enumerate(plan.trials, start=1):
        done = plan.done(out, trial)
        if done is None:
            left.append((place, trial))
        else:
            runs[trial] = done
    say(f"{plan.name}: {len(plan.trials)} runs, {len(runs)} of them made already" if runs else
        f"{plan.name}: {len(plan.trials)} runs")
    try:
        if left:
            with open_port(port, baud) as line:
                _go_on(plan, line, left, runs, out, force=force, realtime=realtime, view=view)
    except (KeyboardInterrupt, StationError):
        note(f"{len(runs)} of {len(plan.trials)} runs are made; the same command goes on from here")
        raise
    finally:
        found = _tell(plan, runs, out) if runs else {}
    return found


def _controller(name: str, folder: Path, rig: Rig) -> dict[str, Any]:
    from station.control.named import NAMED

    return controller_spec(name if name in NAMED else str(folder / name), rig.sample_rate)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {out}: a folder is wanted for a plan's runs ({error.strerror})") from None


def _need_own_table(plan: Plan, path: Path) -> None:
    """Refuse a folder whose table is not this plan's: it would be replaced."""
    if path.exists() and said_in(path, "plan") != plan.identity:
        raise UsageError(f"{path}: of another plan, an earlier text of this one, or no plan at all; name another "
                         "--out")


def _go_on(plan: Plan, line: Port, left: list[tuple[int, Trial]], runs: dict[Trial, Run], out: Path, *, force: bool,
           realtime: bool, view: bool) -> None:
    from station.loop.run_test import rest_position
    from station.runs import load_run

    shown = live_view(plan.rig) if view else None
    home: int | None = None
    for place, trial in left:
        zero_id, encoder = rest_position(line, plan.rig, plan.settle)
        if home is None:
            home = _home(runs, zero_id, encoder)
        if abs(encoder - home) > plan.rest_within:
            raise WorkError(f"{line.url}: before {trial.name} the arm rests at {encoder} counts, {abs(encoder - home)} "
                            f"from where the plan began ({home}); rest_within is {plan.rest_within:g}; bring it back, "
                            "then give the same command again")
        aside = plan.set_aside(out, trial)
        if aside is not None:
            note(f"{aside}: ended early; kept, and its test is made again")
        path = out / trial.file_name
        result = perform(line, plan.rig, trial.controller, trial.test, log_sink(path, shown=shown), trial.reference,
                         metadata=plan.metadata(trial, home, place), force=force, realtime=realtime,
                         answer_ticks=plan.answer_ticks)
        runs[trial] = load_run(path)
        counts = result.counts
        say(f"{place}/{len(plan.trials)} {path.name}: {counts.samples} samples, {counts.lost} lost, "
            f"{counts.unanswered} without command")


def _home(runs: dict[Trial, Run], zero_id: str, encoder: int) -> int:
    """Where the plan began, as its runs say if they count from the same zero; else here."""
    for run in runs.values():
        home = run.metadata.entries().get("home")
        if run.metadata.zero_id == zero_id and isinstance(home, int):
            return home
    return encoder


def _tell(plan: Plan, runs: dict[Trial, Run], out: Path) -> dict[str, Any]:
    """The table of all tests, with the scatter between repeats; the same as JSON in the folder."""
    from station.runs.quality import Scatter, quality, repeatability

    shown = table(f"{plan.name}: mean ± standard deviation between repeats", "test", "runs",
                  *(title for title, _ in _FIGURES.values()), "encoder ±", "accel ±")
    written = []
    for index in sorted({trial.index for trial in plan.trials}):
        trials = [trial for trial in plan.trials if trial.index == index]
        made = {trial: runs[trial] for trial in sorted(trials, key=lambda t: t.repeat) if trial in runs}
        found = [quality(run, plan.rig.command_limit) for run in made.values()]
        scatter = {key: Scatter.of([getattr(each, key) for each in found]) for key in _FIGURES}
        spread = {channel: repeatability(list(made.values()), channel) for channel in ("encoder", "accel")}
        row(shown, trials[0].name, f"{len(made)} of {len(trials)}",
            *(_cell(scatter[key], scale) for key, (_, scale) in _FIGURES.items()),
            *(number(spread[channel]) for channel in ("encoder", "accel")))
        written.append({
            "test": trials[0].test, "controller": trials[0].controller, "test_index": index, "name": trials[0].name,
            "repeatability": spread, "scatter": {key: vars(value) for key, value in scatter.items()},
            "runs": [{"file": trial.file_name, "repeat": trial.repeat, **each.as_dict()}
                     for trial, each in zip(made, found, strict=True)]})
    console().print(shown)
    told = {"plan": plan.identity, "seed": plan.seed, "order": plan.order, "rig": plan.rig.name,
            "tests": written}
    write_json(out / RESULTS, told, overwrite=True)
    say(f"{len(runs)} runs in {out}; the table is in {out / RESULTS}")
    return told


def _cell(scatter: Any, scale: float) -> str:
    if scatter.mean is None:
        return "-"
    spread = "" if scatter.sigma is None else f" ± {number(scale * scatter.sigma, 2)}"
    return f"{number(scale * scatter.mean)}{spread}"
