"""In what the runs differ by themselves, and which of them cannot be simulated as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from station.diagnose.thresholds import LIKELY
from station.view.wording.numbers import number, percent, probability, resamples
from station.view.wording.odds import as_good_as_certain

if TYPE_CHECKING:
    from station.diagnose.result import Diagnosis, RunComparison


def differing(diagnosis: Diagnosis) -> str:
    """That the runs differ by themselves, as a clause; empty where that is not likelier than not."""
    found = diagnosis.between_runs
    most = max(found.probability.values(), default=0.0) if found is not None else 0.0
    if most <= LIKELY:
        return ""
    where = "from one half of the run to the other" if len(diagnosis.runs) == 1 else "from run to run"
    hedge = "" if most >= as_good_as_certain(diagnosis.outside) else "probably "
    return f"{where} the motor {hedge}does more or less by itself"


def predicted_ahead(comparisons: Sequence[RunComparison]) -> list[str]:
    """Which runs are predicted a time ahead and not simulated as a whole, a sentence for each reason."""
    found: dict[tuple[str, float], list[str]] = {}
    for row in comparisons:
        if row.seconds_ahead is not None:
            found.setdefault((row.not_closed, row.seconds_ahead), []).append(row.run.name)
    return [f"{', '.join(names)}: predicted {seconds:g} s ahead of what was read, by the logged command, and not "
            f"simulated as a whole, for {why}." for (why, seconds), names in found.items()]


def between_runs(diagnosis: Diagnosis) -> str:
    """In what the runs differ by themselves, each with how probable it is and how many resamples show it, as a
    sentence; empty where they do not."""
    found = diagnosis.between_runs
    if found is None or not found.probability:
        return ""
    told = {"share": (f"{percent(found.share)} of its command", percent),
            "constant": (f"{number(found.constant, 2)} counts of command", lambda value: number(value, 2))}
    parts = []
    for name, (size, worded) in told.items():
        if name in found.probability:
            values = sorted((getattr(row, name), row.run) for row in found.runs)
            least, most = (f"{worded(value)} in {run}" for value, run in (values[0], values[-1]))
            parts.append(f"by {size}, from {least} to {most} ({probability(found.probability[name])} probable, shown "
                         f"by {resamples(found.stability[name])})")
    where, what = (("From one half of the run to the other", "A motor that warms up") if len(diagnosis.runs) == 1 else
                   ("From run to run", "A supply whose voltage differs between tests, or another load on the motor,"))
    words = (f"{where} the motor does more or less {' and '.join(parts)}, as no cause with one value can (standard "
             "deviations).")
    return f"{words} {what} does that to a share of the command." if "share" in found.probability else words
