"""Paced loop: Station's host and a bare C host by turns, over a pseudo-terminal and a loopback socket.

    python scripts/bench/loop_paced.py [--rate 1000] [--turns 10] [--seconds 60] [--lines pty tcp] [--no-view]
    python scripts/bench/loop_paced.py --highest      the highest rate at which Station holds, per line

Station runs ``run_test`` in real-time mode with the log on and a live view that a viewer takes (headless); the C host
runs at the same real-time priority.  The device is a process of its own, above both where the system allows it (a
board's timer is not disturbed by a host's load either).  A tick is late when its command did not come in time (held or
zeroed, by the device's own account).  Ticks on which the device itself began more than 0.1 ms late, and the ticks after
them, are counted apart, for both hosts alike.

Wanted, on each line: the bootstrap 95 % interval of the ratio of late shares (Station / C) reaches down to 1.2, or both
shares are below 0.05 %; median and 99 % of the answers at most twice the C host's.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from station.control.compensators import Compensator
from station.device.build import compilers
from station.device.firmware import firmware_folder
from station.device.port import open_port
from station.device.protocol import Status
from station.device.server import DeviceProcess
from station.errors import WorkError
from station.loop.run_test import run_test
from station.rig import Rig, load_rig
from station.runs.mcap_log import McapLogWriter
from station.runs.run import RunMetadata
from station.view.live import LiveView, LogAndView
from station.view.viewer import free_port, start

WANTED_RATIO, WANTED_SHARE, WANTED_LATENCY = 1.2, 0.0005, 2.0
RATES = (500, 1000, 1500, 2000, 2500, 3000, 4000)
DEVICE_PRIORITY, HOST_PRIORITY = 60, 50
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


def bare_turn(host: Path, line: str, url: str, ticks: int, rate: int) -> Turn:
    """One turn of the C host."""
    where = url.rsplit(":", 1)[1] if line == "tcp" else url
    process = subprocess.Popen([str(host), line, where, str(ticks), str(1000 * rate)], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    realtime(process.pid, HOST_PRIORITY)
    out, err = process.communicate()
    if process.returncode:
        raise SystemExit(f"the C host failed: {err}")
    done = SimpleNamespace(stdout=out)
    words = done.stdout.split()
    return Turn(*(int(word) for word in words[:5]), *(float(word) for word in words[5:]))


def station_turn(folder: Path, url: str, ticks: int, rig: Rig | None = None, viewer: str | None = None) -> Turn:
    """One turn of ``run_test`` with log and view on; after a fault it goes on until all ticks are seen."""
    rig = rig or load_rig("sflr")
    compensator = Compensator.from_spec({"kind": "lead", "gain": 20.0, "zero": 31.41592653589793,
                                         "pole": 125.66370614359172}, rig.sample_rate, rig.amplifier.limit)
    logs: list[StatusLog] = []
    views: list[LiveView] = []

    def make(metadata: object) -> StatusLog:
        logs.append(StatusLog(folder / "turn.mcap", metadata))
        if viewer is None:
            return logs[-1]
        view = LiveView(rig, url=viewer)
        view.wait()
        views.append(view)
        return LogAndView(logs[-1], view, print)

    seen = faults = unanswered = apart = late = lost = 0
    latency: list[float] = []
    with open_port(url) as port:
        while seen < ticks:
            n = np.arange(max(ticks - seen, round(rig.sample_rate)))
            reference = np.where((n < 0.25 * rig.sample_rate) | (n // 250 % 2 == 1), 0.0, 50.0)
            logs.clear()
            try:
                run_test(port, rig, compensator, reference, log_sink=make, force=True, realtime=True)
            except WorkError as error:
                if "in fault" not in str(error):
                    raise
                faults += 1
            if not logs:  # the fault came while the arm's rest was measured
                continue
            status = np.array([row[0] for row in logs[-1].rows], dtype=int)
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


def realtime(process: int, priority: int = DEVICE_PRIORITY) -> str:
    """Put a process under the real-time scheduler; what became of it, in words."""
    try:
        os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(priority))
        return "real-time scheduling (SCHED_FIFO)"
    except (AttributeError, OSError) as error:
        return f"ordinary scheduling ({error})"


@dataclass(frozen=True)
class Verdict:
    """What the turns of one line at one rate come to."""

    ours: float
    theirs: float
    low: float
    high: float
    median_ratio: float
    p99_ratio: float

    @classmethod
    def of(cls, station: list[Turn], bare: list[Turn]) -> Verdict:
        """Shares and their interval; latencies as medians over the turns."""
        ratio = [float(np.median([getattr(turn, key) for turn in station])
                       / np.median([getattr(turn, key) for turn in bare])) for key in ("median_us", "p99_us")]
        return cls(share(station), share(bare), *interval(station, bare), *ratio)

    def holds(self, ratio: float) -> bool:
        """Whether it keeps within a ratio of late shares."""
        return self.low <= ratio or max(self.ours, self.theirs) < WANTED_SHARE

    @property
    def met(self) -> bool:
        """Whether all that is wanted is so."""
        return self.holds(WANTED_RATIO) and max(self.median_ratio, self.p99_ratio) <= WANTED_LATENCY

    def __str__(self) -> str:
        return (f"late {100 * self.ours:.4f} % against {100 * self.theirs:.4f} %, ratio 95 % interval {self.low:.3g} "
                f"to {self.high:.3g}; answers: median {self.median_ratio:.2f} times, 99 % {self.p99_ratio:.2f} times "
                "the C host's")


def measure(folder: Path, host: Path, line: str, rate: int, turns: int, seconds: float, viewer: str | None) -> Verdict:
    """Take turns on one line at one rate; raw counts of each are printed."""
    rig = load_rig("sflr").model_copy(update={"sample_rate": float(rate)})
    path = folder / f"{rate}.toml"
    path.write_text(rig.to_toml(), encoding="utf-8")
    taken: dict[str, list[Turn]] = {"station": [], "bare C": []}
    with DeviceProcess(str(path), pty=line == "pty", tcp=line == "tcp", speed=1, noise=1.0) as device:
        scheduling = realtime(device.process.pid, DEVICE_PRIORITY)
        print(f"{line}, {rate} Hz; device: {scheduling}; {os.cpu_count()} CPUs, load "
              f"{os.getloadavg()[0]:.1f}\n  host, ticks, unanswered, apart, late among the others, faults, answer "
              "median / p99 us")
        for number in range(turns):
            for who in ("station", "bare C") if number % 2 == 0 else ("bare C", "station"):
                url, ticks = getattr(device.addresses, line), round(seconds * rate)
                turn = (station_turn(folder, url, ticks, rig, viewer) if who == "station"
                        else bare_turn(host, line, url, ticks, rate))
                taken[who].append(turn)
                print(f"  {who:8} {turn.seen} {turn.unanswered} {turn.apart} {turn.late} {turn.faults} "
                      f"{turn.median_us:.1f} / {turn.p99_us:.1f}", flush=True)
    return Verdict.of(taken["station"], taken["bare C"])


def main() -> int:
    """Take turns; print raw counts of each, then the verdict of each line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=int, default=1000)
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--lines", nargs="+", choices=("pty", "tcp"), default=["pty", "tcp"])
    parser.add_argument("--no-view", action="store_true")
    parser.add_argument("--highest", action="store_true", help="go up in rate for as long as a ratio of 2 holds")
    options = parser.parse_args()
    met = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        host = build_host(folder)
        port = free_port()
        viewer = None if options.no_view else start(["--serve-grpc"], port)
        address = None if viewer is None else f"rerun+http://127.0.0.1:{port}/proxy"
        try:
            for line in options.lines:
                if not options.highest:
                    found = measure(folder, host, line, options.rate, options.turns, options.seconds, address)
                    met &= found.met
                    print(f"{line}: {found}: {'met' if found.met else 'NOT MET'}", flush=True)
                    continue
                highest = 0
                for rate in RATES:
                    found = measure(folder, host, line, rate, options.turns, options.seconds, address)
                    print(f"{line}, {rate} Hz: {found}", flush=True)
                    if not found.holds(2.0):
                        break
                    highest = rate
                print(f"{line}: held within a ratio of 2 up to {highest} Hz", flush=True)
        finally:
            if viewer is not None:
                viewer.terminate()
                viewer.wait()
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
