"""Paced loop at 500 Hz through the emulated Cortex-M3 and through the host board, by turns, over a loopback socket.

    python scripts/bench/loop_emulated.py [--turns 10] [--seconds 60]

Station is the host of both, its log on; the devices are under the real-time scheduler where the system allows it (a
board's timer is not disturbed by a host's load either; with --ordinary they are not).  Late is what ``loop_paced.py``
calls late: the command did not come in time, by the device's own account, ticks that began late on the device itself
and those after them counted apart.

Wanted: the late share through the emulated board at most 1.5 times the host board's (or both below 0.05 %), and
nothing lost: every sample of both boards is received or counted.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import psutil
from loop_paced import WANTED_SHARE, Turn, interval, realtime, share, station_turn

from station.device.server import DeviceProcess

RATE, WANTED_RATIO = 500, 1.5
BOARDS = ("mps2_an385", "host")


def all_realtime(process: int) -> None:
    """Put every thread of a device, of the emulator too, under the real-time scheduler."""
    for each in (psutil.Process(process), *psutil.Process(process).children(recursive=True)):
        for thread in each.threads():
            realtime(thread.id)


def one_turn(board: str, folder: Path, ticks: int, ordinary: bool) -> Turn:
    """Station at a board, in real time."""
    with DeviceProcess("sflr", pty=False, speed=1, noise=1.0, board=board) as device:
        if not ordinary:
            all_realtime(device.process.pid)
        return station_turn(folder, device.addresses.tcp, ticks)


def main() -> int:
    """Take turns; print raw counts of each, then the verdict."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--ordinary", action="store_true", help="no real-time scheduling for the devices")
    options = parser.parse_args()
    ticks = round(options.seconds * RATE)
    turns: dict[str, list[Turn]] = {board: [] for board in BOARDS}
    print(f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}")
    print("board, ticks, unanswered, apart, late among the others, faults, lost, answer median / p99 us")
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.turns):
            for board in BOARDS if number % 2 == 0 else BOARDS[::-1]:
                turn = one_turn(board, Path(folder), ticks, options.ordinary)
                turns[board].append(turn)
                print(f"  {board:10} {turn.seen} {turn.unanswered} {turn.apart} {turn.late} {turn.faults} {turn.lost} "
                      f"{turn.median_us:.1f} / {turn.p99_us:.1f}", flush=True)
    emulated, host = turns["mps2_an385"], turns["host"]
    ours, theirs = share(emulated), share(host)
    low, high = interval(emulated, host)
    lost = sum(turn.lost for turn in emulated)
    good = (ours <= WANTED_RATIO * theirs or max(ours, theirs) < WANTED_SHARE) and lost == 0
    print(f"late {100 * ours:.4f} % against {100 * theirs:.4f} %, ratio 95 % interval {low:.3g} to {high:.3g}; "
          f"{lost} lost: {'met' if good else 'NOT MET'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
