"""In what the runs differ by themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.view.wording.numbers import number, percent, probability, resamples

if TYPE_CHECKING:
    from station.diagnose.result import Diagnosis


def differing(diagnosis: Diagnosis) -> str:
    """That the runs differ by themselves, as a clause; empty where they do not."""
    found = diagnosis.between_runs
    where = "from one half of the run to the other" if len(diagnosis.runs) == 1 else "from run to run"
    return f"{where} the motor does more or less by itself" if found is not None and found.probability else ""


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
                   ("From run to run", "A supply whose voltage differs between tests"))
    words = (f"{where} the motor does more or less {' and '.join(parts)}, as no cause with one value can (standard "
             "deviations).")
    return f"{words} {what} does that to a share of the command." if "share" in found.probability else words
