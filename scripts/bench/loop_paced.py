"""Paced loop at 500 Hz: Station's host and a bare C host by turns, over a pseudo-terminal and a loopback socket.

    python scripts/bench/loop_paced.py [--turns 10] [--seconds 60] [--lines pty tcp]

The device is a process of its own, under the real-time scheduler where the system allows it (a board's timer is not
disturbed by a host's load either).  A tick is late when its command did not come in time (held or zeroed, by the
device's own account).  Ticks on which the device itself began more than 0.1 ms late, and the ticks after them, are
counted apart, for both hosts alike.

Wanted, on each line: the bootstrap 95 % interval of the ratio of late shares (Station / C) reaches down to 1.5, or
both shares are below 0.05 %.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from station.control.compensators import Compensator
from station.device.build import compilers
from station.device.firmware import firmware_folder
from station.device.port import open_port
from station.device.protocol import Status
from station.device.server import DeviceProcess
from station.errors import WorkError
from station.loop.run_test import run_test
from station.rig import load_rig
from station.runs.mcap_log import McapLogWriter
from station.runs.run import RunMetadata

RATE = 500
WANTED_RATIO, WANTED_SHARE = 1.5, 0.0005
RESAMPLES = 10_000


@dataclass(frozen=True)
class Turn:
    """One turn of one host: ticks seen, unanswered, counted apart, unanswered among the others, faults, latency, lost.
    """

    seen: int
    unanswered: int
    apart: int
    late: int
    faults: int
    median_us: float
    p99_us: float
    lost: int = 0

    @property
    def judged(self) -> int:
        """Ticks not counted apart."""
        return self.seen - self.apart


class StatusLog:
    """The MCAP log, with status and latency of each row kept."""

    def __init__(self, path: Path, metadata: object) -> None:
        self._log = McapLogWriter(path, metadata, overwrite=True, blueprint=False)
        self.rows: list[tuple[int, float]] = []
        self.close = self._log.close
        self.lost = 0

    def update(self, metadata: RunMetadata) -> None:
        """Log the completed metadata; keep what was lost."""
        self._log.update(metadata)
        self.lost = metadata.counts["lost"]

    def append(self, row: tuple[float, ...]) -> None:
        """Log the row and keep what is judged."""
        self._log.append(row)
        self.rows.append((int(row[8]), row[10]))


def build_host(folder: Path) -> Path:
    """Compile the bare host."""
    core, target = firmware_folder() / "core", folder / "host"
    sources = [Path(__file__).with_name("host.c"), core / "frame.c", core / "protocol.c"]
    subprocess.run([*compilers()[0], "-std=c11", "-O2", f"-I{core}", "-o", str(target), *map(str, sources)], check=True)
    return target


def bare_turn(host: Path, line: str, url: str, ticks: int) -> Turn:
    """One turn of the C host."""
    where = url.rsplit(":", 1)[1] if line == "tcp" else url
    done = subprocess.run([str(host), line, where, str(ticks)], capture_output=True, text=True, check=True)
    words = done.stdout.split()
    return Turn(*(int(word) for word in words[:5]), *(float(word) for word in words[5:]))


def station_turn(folder: Path, url: str, ticks: int) -> Turn:
    """One turn of ``run_test`` with the log on; after a fault it goes on until all ticks are seen."""
    rig = load_rig("sflr")
    compensator = Compensator.from_spec({"kind": "lead", "gain": 20.0, "zero": 31.41592653589793,
                                         "pole": 125.66370614359172}, rig.sample_rate, rig.amplifier.limit)
    logs: list[StatusLog] = []

    def make(metadata: object) -> StatusLog:
        logs.append(StatusLog(folder / "turn.mcap", metadata))
        return logs[-1]

    seen = faults = unanswered = apart = late = lost = 0
    latency: list[float] = []
    with open_port(url) as port:
        while seen < ticks:
            n = np.arange(ticks - seen if ticks - seen > 1 else 2)
            reference = np.where((n < 125) | (n // 250 % 2 == 1), 0.0, 50.0)
            try:
                run_test(port, rig, compensator, reference, log_sink=make, accel_zero=0.0, relative=False)
            except WorkError as error:
                if "in fault" not in str(error):
                    raise
                faults += 1
            status = np.array([row[0] for row in logs[-1].rows])
            latency += [row[1] for row in logs[-1].rows]
            woke = (status & Status.WOKE_LATE) != 0
            aside = woke | np.concatenate(([False], woke[:-1]))
            missed = (status & (Status.HELD | Status.ZEROED)) != 0
            seen += len(status)
            lost += int(logs[-1].lost)
            unanswered += int(missed.sum())
            apart += int(aside.sum())
            late += int((missed & ~aside).sum())
    median, p99 = np.nanpercentile(latency, (50, 99)) * 1e6
    return Turn(seen, unanswered, apart, late, faults, float(median), float(p99), lost)


def share(turns: list[Turn]) -> float:
    """Late ticks among those judged."""
    return sum(turn.late for turn in turns) / max(sum(turn.judged for turn in turns), 1)


def interval(station: list[Turn], bare: list[Turn]) -> tuple[float, float]:
    """Bootstrap 95 % interval of the ratio of late shares, whole pairs of turns drawn again."""
    random = np.random.default_rng(0)
    ratios = []
    for drawn in random.integers(0, len(station), (RESAMPLES, len(station))):
        ours, theirs = share([station[i] for i in drawn]), share([bare[i] for i in drawn])
        ratios.append(1.0 if ours == theirs else ours / theirs if theirs else np.inf)
    low, high = np.percentile(ratios, (2.5, 97.5), method="nearest")
    return float(low), float(high)


def realtime(process: int) -> str:
    """Put the device under the real-time scheduler; what became of it, in words."""
    try:
        os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(50))
        return "real-time scheduling (SCHED_FIFO)"
    except (AttributeError, OSError) as error:
        return f"ordinary scheduling ({error})"


def main() -> int:
    """Take turns; print raw counts of each, then the verdict of each line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--lines", nargs="+", choices=("pty", "tcp"), default=["pty", "tcp"])
    options = parser.parse_args()
    ticks, met = round(options.seconds * RATE), True
    with tempfile.TemporaryDirectory() as name, DeviceProcess("sflr", speed=1, noise=1.0) as device:
        folder = Path(name)
        host = build_host(folder)
        print(f"device: {realtime(device.process.pid)}; {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}")
        for line in options.lines:
            url = getattr(device.addresses, line)
            turns: dict[str, list[Turn]] = {"station": [], "bare C": []}
            print(f"{line}: host, ticks, unanswered, apart, late among the others, faults, answer median / p99 us")
            for number in range(options.turns):
                order = ("station", "bare C") if number % 2 == 0 else ("bare C", "station")
                for who in order:
                    turn = (station_turn(folder, url, ticks) if who == "station"
                            else bare_turn(host, line, url, ticks))
                    turns[who].append(turn)
                    print(f"  {who:8} {turn.seen} {turn.unanswered} {turn.apart} {turn.late} {turn.faults} "
                          f"{turn.median_us:.1f} / {turn.p99_us:.1f}", flush=True)
            ours, theirs = share(turns["station"]), share(turns["bare C"])
            low, high = interval(turns["station"], turns["bare C"])
            good = low <= WANTED_RATIO or max(ours, theirs) < WANTED_SHARE
            met &= good
            print(f"{line}: late {100 * ours:.4f} % against {100 * theirs:.4f} %, ratio 95 % interval {low:.3g} to "
                  f"{high:.3g}: {'met' if good else 'NOT MET'}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
