"""The ticks of a log of another program, from its times: rows that were lost, stamps that jitter.

A row's tick is its number n.  Where a log does not count, a gap of a whole number of periods tells how many rows were
lost.  Stamps of a timer's ticks by another clock lie about a straight line; where each is nearer to its own tick than
to any other, the ticks are known, and the time of a row is that of its tick.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from station.runs.columns import place, time_fault

JITTER = 1.0 / 3.0
"""Largest share of a period by which a stamp may be off its tick.  Up to a half ticks cannot be mistaken."""
WHOLE = 0.25
"""Largest share of a period by which a gap between neighbouring rows may be off a whole number of them."""
SINGLE = 0.4
"""Quantile of the gaps that is one period: half of them are, but for a few."""
ENOUGH = 32
"""Rows from which on a straight line through stamps that jitter is one."""
CLOCKS = 1e-4
"""Share by which two quartz clocks of 50 ppm each, in order, may differ: a rate so near to a whole number is that."""
STAMPS = "t_logged"
"""Extra column of such a log: the stamps as they were."""


@dataclass(frozen=True)
class Line:
    """Stamps about a straight line: its period and start (s), and how far they are off it at most, in periods."""

    period: float
    start: float
    off: float

    @classmethod
    def through(cls, t: np.ndarray, n: np.ndarray) -> Line:
        """The line of least squares through times of ticks."""
        index = (n - n[0]).astype(float)
        ticks = index - index.mean()
        period = float(ticks @ t / (ticks @ ticks))
        off = np.abs(t - t.mean() - period * ticks)
        return cls(period, float(t.mean() - period * index.mean()), float(off.max()) / period if period > 0 else np.inf)


def on_ticks(columns: Mapping[str, np.ndarray], first_line: int | None = None,
             ) -> tuple[dict[str, np.ndarray], str | None]:
    """Columns whose times are those of ticks, and what was done to make them so, for people; None: nothing.

    Times that are neither on a grid nor about one, or about two, stay as they are, for ``time_fault`` to refuse.
    """
    columns = dict(columns)
    t, n = columns["t"], columns.get("n")
    if time_fault(t, n) is None:
        return columns, None
    fits = [ticks for ticks in ([_in_a_row(t), _gapped(t)] if n is None else [n])
            if ticks is not None and np.all(np.diff(ticks) > 0) and Line.through(t, ticks).off <= JITTER]
    if len(fits) != 1:
        return columns, None
    if n is None and time_fault(t, fits[0]) is None:
        return columns | {"n": fits[0]}, _lost(fits[0], first_line)
    if len(t) < ENOUGH:
        return columns, None
    return _regular(columns, Line.through(t, fits[0]), fits[0], first_line)


def _in_a_row(t: np.ndarray) -> np.ndarray | None:
    """The tick of each row where none was lost, of enough rows for a line."""
    return np.arange(len(t)) if len(t) >= ENOUGH else None


def _gapped(t: np.ndarray) -> np.ndarray | None:
    """The tick of each row where every gap is a whole number of periods, most of them one and some more; else None."""
    gaps = np.diff(t)
    period = float(np.quantile(gaps, SINGLE, method="lower"))
    if period <= 0.0:
        return None
    period = float(np.mean(gaps[np.abs(gaps / period - 1.0) <= WHOLE]))
    steps = np.round(gaps / period)
    if np.any(steps < 1.0) or np.any(np.abs(gaps / period - steps) > WHOLE) or not 1.0 < steps.max() < 2.0**31:
        return None
    return np.concatenate([[0], np.cumsum(steps.astype(np.int64))])


def _regular(columns: dict[str, np.ndarray], line: Line, ticks: np.ndarray, first_line: int | None,
             ) -> tuple[dict[str, np.ndarray], str]:
    """The columns with each row's time that of its tick, and what was done."""
    rate = 1.0 / line.period
    whole = round(rate)
    rate = float(whole) if abs(rate - whole) <= CLOCKS * rate else float(f"{rate:.9g}")
    start = 0.0 if abs(line.start) <= JITTER * line.period else line.start
    said = (f"the times jitter by up to {100.0 * line.off:.0f} % of a period about the ticks of {rate:.9g} Hz; each "
            f"row is taken at its tick, and the times as they were are kept in the column {STAMPS}")
    made = {**columns, "t": start + (ticks - ticks[0]) / rate}
    made.setdefault(STAMPS, columns["t"])
    if "n" not in columns and ticks[-1] >= len(ticks):
        return made | {"n": ticks}, f"{_lost(ticks, first_line)}; {said}"
    return made, said


def _lost(ticks: np.ndarray, first_line: int | None) -> str:
    missing = int(ticks[-1]) + 1 - len(ticks)
    row = int(np.argmax(np.diff(ticks) > 1)) + 1
    return f"by the times {missing} rows are missing, the first before {place(row, first_line)}"
