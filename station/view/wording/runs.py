"""In what the runs differ by themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.view.wording.numbers import number, percent, probability, resamples

if TYPE_CHECKING:
    from station.diagnose.result import Diagnosis


def differences(diagnosis: Diagnosis) -> str:
    """How probable it is that the runs differ, and how many resamples show it; empty where they do not."""
    found = diagnosis.between_runs
    return "" if found is None or not found.probability else (
        f"{probability(min(found.probability.values()))} probable, shown by {resamples(min(found.stability.values()))}")


def between_runs(diagnosis: Diagnosis) -> str:
    """In what the runs differ by themselves, as a sentence; empty where they do not."""
    found = diagnosis.between_runs
    if found is None:
        return ""
    sizes = {"share": f"{percent(found.share)} of its command", "constant": f"{number(found.constant, 2)} counts"}
    told = " and ".join(size for name, size in sizes.items() if name in found.probability)
    if not told:
        return ""
    where, what = (("From one half of the run to the other", "A motor that warms up") if len(diagnosis.runs) == 1 else
                   ("From run to run", "A supply whose voltage differs between tests"))
    words = f"{where} the motor does more or less by {told}, as no cause with one value can (standard deviations)"
    if found.share is None:
        return f"{words}."
    least, most = (pick(found.runs, key=lambda row: row.share) for pick in (min, max))
    return (f"{words}: from {percent(least.share)} in {least.run} to {percent(most.share)} in {most.run}. {what} does "
            "that.")
