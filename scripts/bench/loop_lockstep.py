"""Lockstep loop over sim://: samples per second of host compensator, firmware core and plant model together.

    python scripts/bench/loop_lockstep.py [--seconds 5] [--no-log]

Wanted: more than 30,000 samples/s.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from station.control.compensators import Compensator
from station.device.port import open_port
from station.loop.run_test import run_test
from station.loop.sink import MemorySink
from station.rig import load_rig
from station.runs.mcap_log import McapLogWriter

WANTED = 30_000.0
ROWS = 20_000


def main() -> int:
    """Run for some seconds; print each run's rate and the median."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--no-log", action="store_true", help="keep the rows in memory")
    options = parser.parse_args()
    rig = load_rig("sflr")
    compensator = Compensator.from_spec({"kind": "lead", "gain": 20.0, "zero": 31.41592653589793,
                                         "pole": 125.66370614359172}, rig.sample_rate, rig.amplifier.limit)
    reference = np.where(np.arange(ROWS) // 500 % 2, 50.0, 0.0)
    rates, end = [], None
    with tempfile.TemporaryDirectory() as folder, open_port("sim://sflr?noise=1") as port:
        while end is None or time.perf_counter() < end:
            sink = (partial(McapLogWriter, Path(folder) / f"{len(rates)}.mcap") if not options.no_log else MemorySink)
            spent = time.process_time()
            result = run_test(port, rig, compensator, reference, log_sink=sink)
            end = end or time.perf_counter() + options.seconds  # the first run, with its compilation, is not counted
            if result.counts.samples != ROWS or result.counts.unanswered:
                print(f"lost or late samples in lockstep: {result.counts}")
                return 1
            spent = time.process_time() - spent
            rates.append(result.counts.samples / result.seconds)
            print(f"{result.counts.samples} samples in {result.seconds:.3f} s ({spent:.3f} s of CPU): "
                  f"{rates[-1]:.0f} samples/s, answer {1e6 * result.latency.median:.1f} us median")
    median = float(np.median(rates[1:] or rates))
    print(f"median {median:.0f} samples/s, wanted more than {WANTED:.0f}: {'met' if median > WANTED else 'NOT MET'}")
    return 0 if median > WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
