"""Soak: two million samples in lockstep with the log on; nothing lost, memory flat.

    python scripts/bench/log_soak.py [--samples 2000000]

Memory is the process's resident set, read twenty times.  Wanted: every row in the log, in order; the resident set of
the last half grows by less than 1 % beyond the arrays of latencies that the test's length asks for.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from station.control.compensators import Compensator
from station.control.named import NAMED
from station.device.port import open_port
from station.loop.run_test import run_test
from station.rig import load_rig
from station.runs import McapLogWriter
from station.runs.mcap_read import scan_mcap


def main() -> int:
    """Run, watch the memory, read the log back."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=2_000_000)
    options = parser.parse_args()
    rig = load_rig("sflr")
    compensator = Compensator.from_spec(NAMED["lead"], rig.sample_rate, rig.command_limit)
    reference = np.where(np.arange(options.samples) // 500 % 2, 50.0, 0.0)
    process, memory = psutil.Process(), []
    begun = time.perf_counter()

    def look(row: int, rows: int) -> None:
        if row >= (len(memory) + 1) * rows // 20:
            memory.append(process.memory_info().rss / 2**20)

    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs")
    with tempfile.TemporaryDirectory() as folder, open_port("sim://sflr?noise=1&seed=1") as port:
        path = Path(folder) / "soak.mcap"
        result = run_test(port, rig, compensator, reference, log_sink=partial(McapLogWriter, path), progress=look)
        spent = time.perf_counter() - begun
        size = path.stat().st_size
        contents = scan_mcap(path)
    n = contents.columns["n"]
    whole = len(n) == options.samples and bool(np.array_equal(n, np.arange(options.samples)))
    counts = result.counts
    arrays = 3 * 8 * options.samples / 2**20  # latency, device and host time of every row, touched as they are filled
    half = memory[len(memory) // 2:]
    growth = half[-1] - half[0]
    allowed = 0.01 * half[0] + 0.5 * arrays + 1.0
    print(f"{counts.samples} samples in {spent:.0f} s ({counts.samples / result.seconds:.0f}/s in the session), "
          f"{counts.lost} lost, {counts.unanswered} without command; log {size / 2**20:.0f} MiB, "
          f"{'every row in order' if whole else f'ROWS MISSING: {len(n)}'}")
    print(f"resident set, MiB: {', '.join(f'{value:.0f}' for value in memory)}; last half grew by {growth:.1f} "
          f"(allowed {allowed:.1f}, of which {0.5 * arrays:.1f} for the rows' own times)")
    good = whole and not counts.lost and not counts.unanswered and growth < allowed
    print("met" if good else "NOT MET")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
