#!/usr/bin/env python3
"""Diagnose the measured logs of two rigs and print the README's tables of what that buys.

    python scripts/measured_rig.py [DATA] [--only sflr|xl330|xl330-no-controller] [--reports FOLDER]

DATA holds the folders sflr and xl330 (default ../shared/data).  Each diagnosis is one call of the command itself,
`station diagnose --rig RIG FILES --json …`; xl330 is done twice, with and without the logs' controller line.  Every
number of the linear and the extended rig is of a run that the fit behind it has not seen: each run is left out in turn.
The arm's best linear rig stands there twice: with one value of each constant for all runs, and, as the diagnosis has it
for comparison, with runs that may differ in what the motor does.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from station.cli import diagnosis as command
from station.diagnose.measures import nrmse, step_measures
from station.diagnose.result import DiagnosisResult, RunComparison
from station.diagnose.validation import leave_each_out, predict_unseen
from station.errors import StationError
from station.estimation.constants import ROUNDS, base_fit
from station.estimation.dataset import dataset
from station.estimation.fitted import weighing_of
from station.estimation.least_squares import fit
from station.estimation.observer import observers
from station.estimation.pool import Pool
from station.estimation.prediction import Predictor
from station.model.simulate import Simulation
from station.runs.run import Run
from station.view import wording

NAMES = {"OL_pulse": "pulse, open loop", "SFLR_P": "P, step 50", "step_response_Gth_comp_no": "lead, step 100",
         "step_response_Gth_comp_Ga": "lead + accelerometer, step 200", "swept": "swept sine, P"}


@contextmanager
def kept() -> Iterator[list[DiagnosisResult]]:
    """What the command found, beside the files that it writes."""
    found: list[DiagnosisResult] = []
    plain = command.save

    def save(result: DiagnosisResult, **files) -> None:
        found.append(result)
        plain(result, **files)

    command.save = save
    try:
        yield found
    finally:
        command.save = plain


def diagnosed(rig: str, files: Sequence[Path], report: Path | None) -> tuple[DiagnosisResult, float]:
    """One run of the command, and its seconds."""
    with tempfile.TemporaryDirectory() as folder, kept() as found:
        begun = time.perf_counter()
        command.diagnose(list(files), rig, str(Path(folder) / "diagnosis.json"), report)
        return found[0], time.perf_counter() - begun


def steps(found: dict[str, float | None]) -> str:
    """Overshoot and settling time, as far as there are any."""
    if not found:
        return ""
    settling = found["settling_time"]
    return f"; {found['overshoot_percent']:.1f} %, " + ("> end" if settling is None else f"{settling:.3f} s")


def fits(run: Run, simulation: Simulation) -> list[float]:
    """100 (1 - nrmse) of angle and, where there is one, acceleration."""
    channels = ("encoder",) if run.accel is None or simulation.accel is None else ("encoder", "accel")
    return [100.0 * (1.0 - nrmse(getattr(run, c), getattr(simulation, c))) for c in channels]


def error(result: DiagnosisResult, run: Run, simulation: Simulation) -> float:
    """Mean absolute error of the angle, mrad."""
    return 1e3 * result.rig.angle_per_count * float(np.mean(np.abs(run.encoder - simulation.encoder)))


def simulations(row: RunComparison) -> list[Simulation]:
    """Nominal, best linear and extended; without causes the extended rig is the linear one."""
    return [row.before, row.refit, row.after or row.refit]


def held_alike(result: DiagnosisResult) -> list[Simulation]:
    """Every run by the linear rig that suits the others best with one value of each constant for all of them."""
    with threadpool_limits(1):
        data = dataset(result.rig, [row.run for row in result.comparisons])
        predictor = Predictor(data, observers(data.rig, data.noise[0]), Pool())
        found = base_fit(predictor)
        for _ in range(ROUNDS):
            weighing = replace(weighing_of(predictor, found), differ=(0.0, 0.0))
            found = fit(predictor, found.space, weighing, found.x, found.own, to_the_end=True)
        return predict_unseen(predictor, found, leave_each_out(predictor, found.weighing, found, far=True))[0]


def arm_table(result: DiagnosisResult) -> None:
    """Fits, overshoot and settling time of each run."""
    print("| run | measured | nominal `sflr` | best linear rig, runs alike | the same, runs differ | extended rig |\n"
          "| --- | --- | --- | --- | --- | --- |")
    every = []
    for row, alike in zip(result.comparisons, held_alike(result), strict=True):
        name = next((text for start, text in NAMES.items() if row.run.name.startswith(start)), row.run.name)
        nominal, *fitted = simulations(row)
        made = [nominal, alike, *fitted]
        every.append([fits(row.run, s) for s in made])
        cells = [" / ".join(f"{fit:.1f}" for fit in f) + steps(step_measures(row.run, s.encoder))
                 for f, s in zip(every[-1], made, strict=True)]
        print(f"| {name} | {steps(step_measures(row.run, row.run.encoder)).removeprefix('; ')} | {' | '.join(cells)} |")
    print("| mean | | " + " | ".join(" / ".join(f"{fit:.1f}" for fit in f) for f in np.mean(every, axis=0)) + " |")


def servo_table(result: DiagnosisResult) -> None:
    """Mean absolute error and fit of each run."""
    print("| run | nominal | best linear rig | extended rig |\n| --- | --- | --- | --- |")
    every = []
    for row in result.comparisons:
        every.append([error(result, row.run, s) for s in simulations(row)])
        cells = [f"{e:.1f} mrad; {fits(row.run, s)[0]:.1f}" for e, s in zip(every[-1], simulations(row), strict=True)]
        print(f"| {row.run.name.replace('_', ' ')} | {' | '.join(cells)} |")
    print("| mean | " + " | ".join(f"{e:.1f} mrad" for e in np.mean(every, axis=0)) + " |")


def said(result: DiagnosisResult, seconds: float) -> None:
    """Verdict, causes, rivals and notes."""
    found = result.diagnosis
    print(f"\nverdict: {found.verdict}; {seconds:.0f} s")
    for cause in found.causes:
        values = ", ".join(f"{name.replace('_', ' ')} {wording.interval(e)}" for name, e in cause.parameters.items())
        print(f"- {wording.cause_title(cause.effect, cause.at)}: probability {cause.probability:.2f}, "
              f"stability {cause.stability:.2f}; {values}")
        for rival in cause.rivals:
            print(f"  in its place: {wording.cause_title(rival.effect, rival.at)} {rival.probability:.2f}")
    for ranked in result.ranking[:10]:
        print(f"  tried {wording.cause_title(ranked.effect, ranked.at)}: probability {ranked.probability:.3f}, "
              f"2 dln L {ranked.delta_chi2:.1f} {ranked.note}")
    for row in found.gain.runs:
        ahead = ", ".join(f"{t} ahead {100 * g.nrmse_before:.1f} -> {100 * g.nrmse_after:.1f} %"
                          for t, g in row.ahead.items())
        print(f"  {row.run}: {ahead}")
    print("\n".join(f"  {line}" for line in (wording.disturbance(found), *result.notes)))


def main() -> None:
    """Run the diagnoses and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--only", choices=("sflr", "xl330", "xl330-no-controller"))
    parser.add_argument("--reports", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    servo = options.data / "xl330"
    with tempfile.TemporaryDirectory() as folder:
        stripped = []
        for path in sorted(servo.glob("*.csv")):
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            stripped.append(Path(folder) / path.name)
            stripped[-1].write_text("".join(line for line in lines if not line.startswith("# controller")),
                                    encoding="utf-8")
        tasks = {"sflr": ("sflr", sorted((options.data / "sflr").glob("*.txt")), arm_table),
                 "xl330": (str(servo / "rig.toml"), sorted(servo.glob("*.csv")), servo_table),
                 "xl330-no-controller": (str(servo / "rig.toml"), stripped, servo_table)}
        for name, (rig, files, table) in tasks.items():
            if options.only in (None, name):
                report = None if options.reports is None else options.reports / f"{name}.html"
                result, seconds = diagnosed(rig, files, report)
                print(f"\n## {name}\n")
                table(result)
                said(result, seconds)
                sys.stdout.flush()


if __name__ == "__main__":
    try:
        main()
    except StationError as error_:
        sys.exit(str(error_))
