"""What the rig file's own simulation gets wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from station.diagnose.measures import floor, nrmse, step_measures
from station.diagnose.result import RunComparison, Wrong
from station.diagnose.thresholds import SHOWN_COUNTS, SHOWN_SETTLING, SHOWN_SHARE


def wrong(comparisons: Sequence[RunComparison], noise: Sequence[float]) -> list[Wrong]:
    """What the nominal rig gets wrong, the largest first; beside an nrmse stands the floor that noise alone sets."""
    found = []
    for c in comparisons:
        run, simulation, rows = c.run, c.before, c.rows
        count = 100.0 / max(np.ptp(run.reference), 1.0)
        measured, simulated = (step_measures(run, encoder, c.part) for encoder in (run.encoder, simulation.encoder))
        for name in measured:
            m, s = measured[name], simulated[name]
            if name == "overshoot_percent" and m is not None and s is not None and abs(m - s) > SHOWN_COUNTS * count:
                found.append((abs(m - s), Wrong(run=run.name, channel="encoder", measure=name, simulated=s,
                                                measured=m)))
            elif name == "settling_time" and m != s and (m is None or s is None or abs(m - s) > SHOWN_SETTLING):
                found.append((0.0, Wrong(run=run.name, channel="encoder", measure=name, simulated=s, measured=m)))
        if not measured:
            peak_m, peak_s = (float(np.max(np.abs(encoder[rows]))) for encoder in (run.encoder, simulation.encoder))
            if abs(peak_m - peak_s) > SHOWN_COUNTS:
                found.append((100.0 * abs(peak_m - peak_s) / max(peak_m, 1.0),
                              Wrong(run=run.name, channel="encoder", measure="peak_counts", simulated=peak_s,
                                    measured=peak_m)))
        channels: tuple[Literal["encoder", "accel"], ...] = ("encoder", "accel")
        for channel, sigma in zip(channels, noise, strict=True):
            m, s = getattr(run, channel), getattr(simulation, channel)
            if m is None or s is None:
                continue
            misfit = nrmse(m[rows], s[rows])
            if SHOWN_SHARE < misfit < np.inf:       # of a channel that never moves there is none
                worst = int(np.argmax(np.abs(m - s) * rows))
                found.append((misfit, Wrong(run=run.name, channel=channel, measure="nrmse", simulated=misfit,
                                            measured=floor(m[rows], sigma),
                                            where=f"largest at t = {run.t[worst]:.3f} s")))
    return [row for _, row in sorted(found, key=lambda row: -row[0])]
