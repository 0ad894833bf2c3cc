"""What the rig file's own simulation gets wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from station.diagnose.measures import floor, nrmse, step_measures
from station.diagnose.result import CHANNELS, Channel, RunComparison, Wrong
from station.diagnose.thresholds import SHOWN_COUNTS, SHOWN_SETTLING, SHOWN_SHARE


def wrong(comparisons: Sequence[RunComparison], noise: Sequence[float]) -> list[Wrong]:
    """What the nominal rig gets wrong: step measures and peaks, then errors of whole runs, of each the largest first.

    Beside an nrmse stands the floor that noise alone sets.  Peaks are counted from the first reading of the run.  What
    is predicted a time ahead is no loop's answer to a test.
    """
    found: list[tuple[float, str, Channel, str, float | None, float | None, str | None]] = []
    for c in comparisons:
        run, simulation, rows = c.run, c.before, c.rows
        count = 100.0 / max(np.ptp(run.reference), 1.0)
        measured, simulated = (step_measures(run, encoder, c.part) for encoder in (run.encoder, simulation.encoder))
        for name, m in measured.items() if c.seconds_ahead is None else ():
            s = simulated[name]
            if name == "overshoot_percent" and m is not None and s is not None and abs(m - s) > SHOWN_COUNTS * count:
                found.append((abs(m - s), run.name, "encoder", name, s, m, None))
            elif name == "settling_time" and m != s and (m is None or s is None or abs(m - s) > SHOWN_SETTLING):
                found.append((0.0, run.name, "encoder", name, s, m, None))
        if not measured and c.seconds_ahead is None:
            m, s = (float(np.max(np.abs(encoder[rows] - run.encoder[0])))
                    for encoder in (run.encoder, simulation.encoder))
            if abs(m - s) > SHOWN_COUNTS:
                found.append((100.0 * abs(m - s) / max(m, 1.0), run.name, "encoder", "peak_counts", s, m, None))
        for channel, sigma in zip(CHANNELS, noise, strict=True):
            read, made = getattr(run, channel), getattr(simulation, channel)
            if read is None or made is None:
                continue
            misfit = nrmse(read[rows], made[rows])
            if SHOWN_SHARE < misfit < np.inf:       # of a channel that never moves there is none
                worst = int(np.argmax(np.abs(read - made) * rows))
                found.append((misfit, run.name, channel, "nrmse", misfit, floor(read[rows], sigma, run.step(channel)),
                              f"largest at t = {run.t[worst]:.3f} s"))
    return [Wrong(run=run, channel=channel, measure=measure, simulated=s, measured=m, where=where)
            for _, run, channel, measure, s, m, where in sorted(found, key=lambda row: (row[3] == "nrmse", -row[0]))]
