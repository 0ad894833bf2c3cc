"""Kill a host at random moments of a paced test; every log must be readable, and lose no more than the last 50 ms.

    python scripts/bench/log_kill.py [--kills 200] [--seed 1] [--line sim]

Each host is a process of its own that runs ``run_test`` with the log on, on a simulated rig in real time: in the same
process, as a thread (``--line sim``: Python answers), or in a process of its own at a pseudo-terminal or a socket
(``pty``, ``tcp``: compiled code answers).  SIGKILL comes 0.2 to 1.5 s after the first row is logged.  Loss is the time
between the kill and the receipt of the last row that can be read, by the clock that both processes share.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from station.device.server import DeviceProcess
from station.runs.mcap_read import scan_mcap

HOST = """
import sys
from functools import partial
import numpy as np
from station.control.compensators import Compensator
from station.device.port import open_port
from station.loop.run_test import run_test
from station.rig import load_rig
from station.runs import McapLogWriter
rig = load_rig("sflr")
compensator = Compensator.from_spec({"kind": "p", "gain": 1.0}, rig.sample_rate, rig.command_limit)
reference = np.where(np.arange(30000) < 100, 0.0, 20.0)
class Log(McapLogWriter):
    def append(self, row):
        super().append(row)
        if row[0] == 0:
            print("running", flush=True)
with open_port(sys.argv[2]) as port:
    run_test(port, rig, compensator, reference, log_sink=partial(Log, sys.argv[1], blueprint=False), accel_zero=0.0,
             relative=True, force=True)
"""
WANTED = 0.05
_ATTEMPTS = 20


def kill_once(path: Path, url: str, wait: float) -> float | None:
    """Seconds lost; None where the device faulted before the kill (a busy machine)."""
    host = subprocess.Popen([sys.executable, "-c", HOST, str(path), url], stdout=subprocess.PIPE,
                            stderr=subprocess.DEVNULL)
    try:
        if not host.stdout.readline():
            return None
        time.sleep(wait)
        if host.poll() is not None:
            return None
        killed = time.perf_counter()
        host.kill()
    finally:
        host.kill()
        host.wait()
        host.stdout.close()
    columns = scan_mcap(path).columns
    if not len(columns["n"]) or not np.array_equal(columns["n"], np.arange(len(columns["n"]))):
        raise SystemExit(f"{path}: rows are missing inside")
    return float(killed - columns["host_time"][-1])


@contextlib.contextmanager
def served(line: str) -> Iterator[str]:
    """The address of a simulated rig in real time."""
    if line == "sim":
        yield "sim://sflr?speed=1"
        return
    with DeviceProcess("sflr", pty=line == "pty", tcp=line == "tcp", speed=1) as device:
        yield getattr(device.addresses, line)


def main() -> int:
    """Kill; print the losses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--line", choices=("sim", "pty", "tcp"), default="sim")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    lost, again = [], 0
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs")
    with tempfile.TemporaryDirectory() as folder, served(options.line) as url:
        while len(lost) < options.kills and again < options.kills * _ATTEMPTS:
            path = Path(folder) / f"{len(lost)}-{again}.mcap"
            found = kill_once(path, url, draw.uniform(0.2, 1.5))
            path.unlink(missing_ok=True)
            if found is None:
                again += 1
                continue
            lost.append(found)
            if found > WANTED:
                print(f"  kill {len(lost)}: {1e3 * found:.1f} ms, load {os.getloadavg()[0]:.1f}", flush=True)
    times = 1e3 * np.array(lost)
    beyond = int(np.count_nonzero(times > 1e3 * WANTED))
    print(f"{len(lost)} kills, every log readable ({again} hosts ended before their kill: the device faulted); lost: "
          f"median {np.median(times):.1f} ms, 90 % {np.percentile(times, 90):.1f}, longest {times.max():.1f}; "
          f"{beyond} beyond {1e3 * WANTED:.0f} ms; load now {os.getloadavg()[0]:.1f}")
    print("met" if not beyond and len(lost) == options.kills else "NOT MET")
    return 0 if not beyond and len(lost) == options.kills else 1


if __name__ == "__main__":
    sys.exit(main())
