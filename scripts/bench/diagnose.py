"""Time of a diagnosis: five runs, a fresh process, compiled code from the cache.

    python scripts/bench/diagnose.py [--seed 3000] [--cases 6] [--disturbance 0 0.02] [--effort full quick]
                                     [--rows 5500 7500] [--hidden clean coulomb_friction@motor backlash ...]

Seeds follow one another through the hidden causes, each case in every world and with every effort; a seed whose five
runs together do not have so many rows is passed over, for their tests last from 2 to 22 s.  Wanted over all (median /
95th percentile): 12 / 45 s, quick 6 / 12 s, of 6,500 rows on 2 cores, from the command to the file.  Beside it the
floor: the CPU that the predictions inside the fits take alone, measured in the same run by one process.  The peak is
that of the largest process.  Unix only (resource usage of a child).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from scripts._setup import KEPT  # noqa: E402
from station.runs import export_run  # noqa: E402
from tests.diagnose.blind import blind_task, made  # noqa: E402
from tests.truth.cases import Case  # noqa: E402

WANTED = {"full": (12.0, 45.0), "quick": (6.0, 12.0)}
"""Median and 95th percentile of the wall seconds, by effort."""
SEEDS = 100
"""Most that are tried for a case."""
TIMED = """
import json, resource, subprocess, sys, time
start = time.perf_counter()
subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, check=True)
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps((time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss)))
"""
"""A small process between this one and the one that is timed: what a process begins with of its parent's memory counts
as its own peak."""
COUNTED = """
import json, sys, threading, time
from station.diagnose.diagnose import diagnose
from station.estimation import prediction
from station.rig import load_rig
from station.runs import load_run
lock, spent, calls, plain = threading.Lock(), 0.0, 0, prediction._predicted
def counted(*given, **named):
    global spent, calls
    start = time.thread_time()
    found = plain(*given, **named)
    start = time.thread_time() - start
    with lock:
        spent, calls = spent + start, calls + 1
    return found
prediction._predicted = counted
runs = [load_run(path) for path in sys.argv[2:]]
cpu = time.process_time()
diagnose(load_rig("sflr"), runs, effort=sys.argv[1], threads=1)     # all of them in this process
print(json.dumps({"calls": calls, "predictions": spent, "cpu": time.process_time() - cpu}))
"""


def timed(arguments: list[str]) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory (MB) of a fresh process."""
    command = [sys.executable, "-c", TIMED, *arguments]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True, env=KEPT)
    wall, spent, peak = json.loads(done.stdout)
    return wall, spent, peak / (2**20 if sys.platform == "darwin" else 2**10)


def cases_of(hidden: str, first: int, levels: Sequence[float], least: int, most: int) -> tuple[list[Case], int]:
    """Of the first seed from ``first`` on whose runs have from least to most rows and hide that in every world, and the
    seed after it."""
    name, _, at = hidden.partition("@")
    for seed in range(first, first + SEEDS):
        try:
            cases = [made(blind_task(seed, [] if name == "clean" else [(name, at or None)], disturbance=level,
                                     sized_in_world=level > 0.0)) for level in levels]
        except ValueError as error:
            print(f"{hidden:24s} seed {seed} not made: {error}", flush=True)
            cases = []
        if cases and all(least <= sum(map(len, case.runs)) <= most for case in cases):
            return cases, seed + 1
    raise SystemExit(f"{hidden}: none of {SEEDS} seeds has {least} to {most} rows that hide it: choose another cause, "
                     "seed or --rows")


def main() -> int:
    """One line per case and effort, then the distribution against what is wanted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=3000, help="of the first case")
    parser.add_argument("--cases", type=int, default=6)
    parser.add_argument("--hidden", nargs="+", default=["clean", "coulomb_friction@motor", "backlash"],
                        metavar="EFFECT[@AT]")
    parser.add_argument("--rows", nargs=2, type=int, default=[5500, 7500], metavar=("LEAST", "MOST"))
    parser.add_argument("--disturbance", nargs="+", type=float, default=[0.0, 0.02], metavar="LEVEL")
    parser.add_argument("--effort", nargs="+", choices=list(WANTED), default=list(WANTED))
    options = parser.parse_args()
    walls: dict[str, list[float]] = {effort: [] for effort in options.effort}
    warm, seed = False, options.seed
    print(f"{'hidden':24s} {'world':>5s} {'effort':>6s} {'rows':>6s} {'wall s':>7s} {'CPU s':>7s} {'peak MB':>8s}   "
          "predictions alone")
    for i in range(options.cases):
        text = options.hidden[i % len(options.hidden)]
        cases, seed = cases_of(text, seed, options.disturbance, *options.rows)
        for level, case in zip(options.disturbance, cases, strict=True):
            with tempfile.TemporaryDirectory() as folder:
                files = [str(Path(folder) / f"{run.name}.csv") for run in case.runs]
                for run, path in zip(case.runs, files, strict=True):
                    export_run(run, Path(path))
                for effort in options.effort:
                    command = [sys.executable, "-m", "station", "diagnose", "--rig", "sflr", *files,
                               "--effort", effort, "--json", str(Path(folder) / "diagnosis.json"), "--overwrite"]
                    if not warm:
                        timed(command)
                        warm = True
                    wall, spent, peak = timed(command)
                    done = subprocess.run([sys.executable, "-c", COUNTED, effort, *files], cwd=ROOT, check=True,
                                          capture_output=True, text=True)
                    alone = json.loads(done.stdout.splitlines()[-1])
                    walls[effort].append(wall)
                    print(f"{text:24s} {level:5g} {effort:>6s} {sum(map(len, case.runs)):6d} {wall:7.1f} {spent:7.1f} "
                          f"{peak:8.0f}   {alone['calls']} predictions in {alone['predictions']:.1f} s of CPU; the "
                          f"diagnosis takes {alone['cpu'] / alone['predictions']:.2f} times that", flush=True)
    met = True
    for effort, seconds in walls.items():
        found = float(np.median(seconds)), float(np.percentile(seconds, 95))
        held = all(f <= w for f, w in zip(found, WANTED[effort], strict=True))
        met = met and held
        print(f"{effort}: median {found[0]:.1f} s, 95th percentile {found[1]:.1f} s of {len(seconds)}, wanted "
              f"{WANTED[effort][0]:g} / {WANTED[effort][1]:g} s: {'met' if held else 'NOT MET'} "
              f"({os.cpu_count()} cores, load {os.getloadavg()[0]:.1f})")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
