"""Time of a diagnosis: five runs, a fresh process, compiled code from the cache.

    python scripts/bench/diagnose.py [--seed 3000] [--hidden clean coulomb_friction@motor backlash ...] [--effort full]

Wanted: < 25 s on 2 cores, from the command to the file.  Beside it the floor: the CPU that the predictions inside the
fits take alone, measured in the same run.  Unix only (resource usage of a child).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from station.runs import export_run  # noqa: E402
from tests.diagnose.blind import blind_task, made  # noqa: E402

WANTED = 25.0
COUNTED = """
import json, sys, threading, time
from station.diagnose.diagnose import diagnose
from station.estimation import prediction
from station.rig import load_rig
from station.runs import load_run
lock, spent, calls, plain = threading.Lock(), 0.0, 0, prediction.predict
def counted(*given, **named):
    global spent, calls
    start = time.thread_time()
    found = plain(*given, **named)
    start = time.thread_time() - start
    with lock:
        spent, calls = spent + start, calls + 1
    return found
prediction.predict = counted
runs = [load_run(path) for path in sys.argv[2:]]
cpu = time.process_time()
diagnose(load_rig("sflr"), runs, effort=sys.argv[1])
print(json.dumps({"calls": calls, "predictions": spent, "cpu": time.process_time() - cpu}))
"""


def timed(arguments: list[str]) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory (MB) of a fresh process."""
    start = time.perf_counter()
    child = subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    wall = time.perf_counter() - start
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(arguments)}: exit {child.returncode}")
    peak = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return wall, usage.ru_utime + usage.ru_stime, peak


def main() -> int:
    """One line per hidden cause, then the longest."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=3000)
    parser.add_argument("--hidden", nargs="+", default=["clean", "coulomb_friction@motor", "backlash"],
                        metavar="EFFECT[@AT]")
    parser.add_argument("--effort", choices=["quick", "full"], default="full")
    options = parser.parse_args()
    longest, warm = 0.0, False
    print(f"{'hidden':28s} {'samples':>7s} {'wall s':>7s} {'CPU s':>7s} {'peak MB':>8s}   predictions alone")
    for text in options.hidden:
        name, _, at = text.partition("@")
        case = made(blind_task(options.seed, [] if name == "clean" else [(name, at or None)]))
        with tempfile.TemporaryDirectory() as folder:
            files = [str(Path(folder) / f"{run.name}.csv") for run in case.runs]
            for run, path in zip(case.runs, files, strict=True):
                export_run(run, Path(path))
            command = [sys.executable, "-m", "station", "diagnose", "--rig", "sflr", *files, "--effort", options.effort,
                       "--json", str(Path(folder) / "diagnosis.json")]
            if not warm:
                timed(command)
                warm = True
            wall, spent, peak = timed(command)
            done = subprocess.run([sys.executable, "-c", COUNTED, options.effort, *files], cwd=ROOT, check=True,
                                  capture_output=True, text=True)
        alone = json.loads(done.stdout.splitlines()[-1])
        longest = max(longest, wall)
        print(f"{text:28s} {sum(map(len, case.runs)):7d} {wall:7.1f} {spent:7.1f} {peak:8.0f}   {alone['calls']} runs "
              f"predicted in {alone['predictions']:.1f} s of CPU; the diagnosis takes "
              f"{alone['cpu'] / alone['predictions']:.2f} times that", flush=True)
    print(f"longest {longest:.1f} s, wanted < {WANTED:.0f} s: {'met' if longest < WANTED else 'NOT MET'} "
          f"({os.cpu_count()} cores, load {os.getloadavg()[0]:.1f})")
    return 0 if longest < WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
