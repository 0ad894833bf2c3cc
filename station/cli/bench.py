"""How fast this machine does the work of a test, on the simulated rig."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from station.cli.options import Json, Overwrite, command, need_outputs
from station.cli.terminal import as_json, console, number, progress, row, say, table

app = typer.Typer()
RIG = "sflr"
TEST = {"kind": "step", "amplitude": 50.0, "duration": 10.0}
"""Under P control; the same on every machine, so that machines can be compared."""
TURNS = 3
"""Of each job, of which the quickest counts: what else a machine does can only slow it (Python's timeit)."""


@command(app, "bench", "Devices", "station bench")
def bench(
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, max=60.0, help=(
        "How long samples are answered in real time, s."))] = 2.0,
    json: Json = None, overwrite: Overwrite = False,
) -> None:
    """Measure how fast this machine does the work of a test of 10 s on the simulated rig sflr, beside the rig's clock.

    The loop in lockstep goes as fast as both sides can: client, compensator, the board's firmware, the plant and the
    log. What a line and a board add, `station loopback --port PORT` measures.
    """
    from station import api
    from station.device.port import open_port
    from station.loop.loopback import loopback

    need_outputs(json, overwrite=overwrite)
    with tempfile.TemporaryDirectory(prefix="station-") as folder, progress("measuring this machine") as update:
        log = Path(folder) / "step.mcap"
        run = api.run_test(f"sim://{RIG}?speed=0", RIG, TEST, "p", out=log)
        jobs: dict[str, Callable[[], Any]] = {
            "simulate it": lambda: api.simulate(RIG, run),
            "run it in lockstep, logged": lambda: api.run_test(f"sim://{RIG}?speed=0", RIG, TEST, "p", out=log,
                                                               overwrite=True),
            "read its log": lambda: api.load_run(log)}
        found = []
        for name, job in jobs.items():
            best = min(map(_timed, [job] * TURNS))
            found.append({"job": name, "seconds_per_sample": best / len(run), "times_real_time": run.t[-1] / best})
            update(0.2 * len(found))
        with open_port(f"sim://{RIG}?speed=1") as line:
            paced = loopback(line, seconds=seconds)
    period = 1.0 / paced.rate
    told = {"rig": RIG, "test": TEST, "rows": len(run), "jobs": found, "rate": paced.rate,
            "answer": asdict(paced.latency), "answered": paced.answered}
    if as_json(json, told, overwrite):
        return
    shown = table(f"A step of {TEST['duration']:g} s, {len(run)} samples", "job", "us a sample", "times real time")
    for one in found:
        row(shown, one["job"], number(1e6 * one["seconds_per_sample"]), f"{one['times_real_time']:,.0f}")
    console().print(shown)
    say(f"Answers in real time at {paced.rate:g} Hz, of the tick's {1e3 * period:g} ms: "
        + ", ".join(f"{words} {number(100.0 * value / period)} %" for words, value in
                    zip(("median", "99 %", "99.9 %", "longest"), asdict(paced.latency).values(), strict=True))
        + f"; {number(100.0 * paced.answered, 5)} % in time")


def _timed(job: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    job()
    return time.perf_counter() - begun
