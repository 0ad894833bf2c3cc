#!/usr/bin/env python3
"""Diagnose the measured logs of the thesis's rig and print the README's table of what that buys.

    python scripts/measured_rig.py [FOLDER] [--report F.html] [--json F]

FOLDER holds the five logs (default ../shared/data/sflr).  Every number of the linear and the extended rig is of a
run that the fit behind it has not seen: each run is left out in turn.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from station.diagnose.diagnose import diagnose
from station.diagnose.measures import nrmse, step_measures
from station.errors import StationError
from station.rig import load_rig
from station.runs import load_run
from station.view.report import write_report

NAMES = {"OL_pulse": "pulse", "SFLR_P": "P, step 50", "step_response_Gth_comp_no": "lead, step 100",
         "step_response_Gth_comp_Ga": "lead + accelerometer, step 200", "swept": "swept sine"}


def _cell(run, simulation) -> str:
    if simulation is None:
        return "–"
    fits = [100.0 * (1.0 - nrmse(getattr(run, c), getattr(simulation, c))) for c in ("encoder", "accel")]
    return f"{fits[0]:.1f} / {fits[1]:.1f}" + _steps(step_measures(run, simulation.encoder))


def _steps(found: dict[str, float | None]) -> str:
    if not found:
        return ""
    settling = found["settling_time"]
    return f"; {found['overshoot_percent']:.1f} %, " + ("> end" if settling is None else f"{settling:.3f} s")


def main() -> None:
    """Run the diagnosis and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[2] / "shared" / "data" / "sflr")
    parser.add_argument("--report", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    begun = time.perf_counter()
    runs = [load_run(path) for path in sorted(options.folder.glob("*.txt"))]
    result = diagnose(load_rig("sflr"), runs)
    print("| run | measured | nominal | best linear | extended |\n| --- | --- | --- | --- | --- |")
    for row in result.comparisons:
        name = next((text for start, text in NAMES.items() if row.run.name.startswith(start)), row.run.name)
        measured = _steps(step_measures(row.run, row.run.encoder)).removeprefix("; ")
        print(f"| {name} | {measured} | {_cell(row.run, row.before)} | {_cell(row.run, row.refit)} "
              f"| {_cell(row.run, row.after)} |")
    found = result.diagnosis
    print(f"\nverdict: {found.verdict}; explained fraction {found.gain.explained_fraction}")
    for cause in found.causes:
        values = ", ".join(f"{k} = {v.value:.4g} ({v.low:.4g} to {v.high:.4g}) {v.unit}"
                           for k, v in cause.parameters.items())
        print(f"  {cause.effect} at {cause.at}: probability {cause.probability:.2f}; {values}")
    for ranked in result.ranking[:12]:
        print(f"  tried {ranked.effect} at {ranked.at}: p {ranked.probability:.3f}, "
              f"chi2 falls by {ranked.delta_chi2:.1f} {ranked.note}")
    print("\n".join(f"  {note}" for note in result.notes))
    print(f"  {time.perf_counter() - begun:.0f} s")
    if options.json:
        options.json.write_text(found.to_json(), encoding="utf-8")
    if options.report:
        write_report(result, options.report)


if __name__ == "__main__":
    try:
        main()
    except StationError as error:
        sys.exit(str(error))
