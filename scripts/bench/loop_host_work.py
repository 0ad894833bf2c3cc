"""What Station's loop costs per sample above a bare pyserial read and write, on the same device.

    python scripts/bench/loop_host_work.py [--turns 15] [--rows 6000]

Both loops run in lockstep over sim://sflr in this process, by turns, so that device and plant cost the same.  The bare
loop reads as many bytes as a sample has and writes a command that was encoded before; Station's decodes, counts,
steps a lead compensator, encodes, answers, watches over the arm and appends the row to a list.  Both are measured in
CPU time of the thread, so that what else runs on the machine counts for neither.

The peer, where it is installed (`pip install tclab`; no test asks for it): TCLab's own loop on its own simulated
device, in turns with the two.  Its user reads T1, works out a proportional command, sets Q1 and lets its Historian log
the row, into its database in memory as it does by default and without one; its bare loop reads T1 and sets Q1.

Wanted: the median difference is below 15 us per sample.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import time

import numpy as np

from station.control.compensators import Compensator
from station.control.named import NAMED
from station.device.client import Client
from station.device.framing import encode
from station.device.port import Port, open_port
from station.device.protocol import MESSAGES
from station.loop.run_test import run_test
from station.loop.sink import MemorySink
from station.rig import load_rig

WANTED_US = 15.0
RIG = load_rig("sflr")


def bare(port: Port, rows: int) -> float:
    """Microseconds per sample of a loop that knows nothing."""
    client = Client(port)
    client.identify()
    client.configure(RIG.sample_rate, 200)
    client.arm()
    client.start()
    command, line, size = MESSAGES["command"], port.serial, MESSAGES["sample"].wire_size
    frames = [encode(command.pack(index=row + 1 & 0xFFFF, command=0), client.session) for row in range(rows)]
    bodies = list(client.inbox)
    while not bodies:  # the first sample may have come with the answer to start
        bodies = client.decoder.feed(line.read(size))
    begun = time.thread_time()
    for frame in frames[:-1]:
        line.write(frame)
        line.read(size)
    spent = time.thread_time() - begun
    client.halt()
    return 1e6 * spent / (rows - 1)


def cost(port: Port, rows: int) -> float:
    """Seconds of CPU of this thread that a whole test takes."""
    compensator = Compensator.from_spec(NAMED["lead"], RIG.sample_rate, RIG.command_limit)
    reference = np.where(np.arange(rows) // 500 % 2, 50.0, 0.0)
    begun = time.thread_time()
    result = run_test(port, RIG, compensator, reference, log_sink=MemorySink)
    spent = time.thread_time() - begun
    if result.counts.unanswered or result.counts.samples != rows:
        raise SystemExit(f"lost or late samples in lockstep: {result.counts}")
    return spent


def station(port: Port, rows: int) -> float:
    """Microseconds of CPU per sample of ``run_test``: a long test less a short one."""
    short = max(rows // 4, 1000)
    return 1e6 * (cost(port, rows + short) - cost(port, short)) / rows


def peer(rows: int, database: str | None) -> float | None:
    """Microseconds of CPU per sample of TCLab's loop above a bare read and write of its device; None: not installed."""
    try:
        from tclab import Historian, TCLabModel
    except ImportError:
        return None
    with contextlib.redirect_stdout(io.StringIO()):
        lab = TCLabModel()
        history = Historian(lab.sources, dbfile=database)
    begun = time.thread_time()
    for row in range(rows):
        lab.Q1(2.0 * (50.0 - lab.T1))
        history.update(row / RIG.sample_rate)
    whole = time.thread_time() - begun
    begun = time.thread_time()
    for _ in range(rows):
        lab.Q1(20.0)
        _ = lab.T1
    return 1e6 * (whole - (time.thread_time() - begun)) / rows


def main() -> int:
    """Take turns; print each, then the median difference."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--rows", type=int, default=6000)
    options = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs")
    pairs, peers = [], []
    with open_port("sim://sflr?noise=1&seed=1") as port:
        station(port, 1000)  # compiles
        for turn in range(options.turns):
            ours, theirs = station(port, options.rows), bare(port, options.rows)
            Client(port).wait(1.0)
            pairs.append((ours, theirs))
            peers.append([peer(options.rows, database) for database in (":memory:", None)])
            print(f"{turn + 1}: Station {ours:.1f} us, bare pyserial {theirs:.1f}, difference {ours - theirs:.1f}")
    both = np.array(pairs)
    median = float(np.median(both[:, 0] - both[:, 1]))
    print(f"median difference {median:.1f} us per sample (ratio {np.median(both[:, 0] / both[:, 1]):.2f}), "
          f"wanted below {WANTED_US:g}: {'met' if median < WANTED_US else 'NOT MET'}")
    if peers[0][0] is None:
        print("TCLab's loop: not measured (pip install tclab)")
    else:
        logged, plain = np.median(np.array(peers), axis=0)
        print(f"TCLab's loop above its own bare one: {logged:.1f} us per sample ({logged / median:.1f} times ours), "
              f"{plain:.1f} us without its database ({plain / median:.1f} times)")
    return 0 if median < WANTED_US else 1


if __name__ == "__main__":
    sys.exit(main())
