"""What the rig file's simulation gets wrong: simulated against measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.view.wording.names import CHANNELS
from station.view.wording.numbers import number, percent

if TYPE_CHECKING:
    from station.diagnose.result import Wrong

_MEASURES = {"overshoot_percent": ("overshoot", 1.0, " %"), "settling_time": ("settling time", 1.0, " s"),
             "peak_counts": ("peak", 1.0, " counts"), "nrmse": ("error", 100.0, " % of the signal")}


def measure(item: Wrong) -> tuple[str, str, str]:
    """What one entry of ``wrong`` measures, simulated and measured, in words."""
    words, factor, unit = _MEASURES.get(item.measure, (item.measure.replace("_", " "), 1.0, ""))

    def shown(value: float | None) -> str:
        if value is None:
            return "never" if item.measure == "settling_time" else "–"
        return f"{number(factor * value)}{unit}"
    measured = shown(item.measured)
    if item.measure == "nrmse" and item.measured is not None:
        measured = f"a right simulation would leave {percent(item.measured)}"
    return f"{CHANNELS[item.channel]} {words}", shown(item.simulated), measured


def fact(item: Wrong) -> tuple[str, str]:
    """One entry of ``wrong`` for a sentence: the measure, and simulated against measured."""
    what, simulated, measured = measure(item)
    if item.measured is None and item.measure != "settling_time":
        return what, simulated
    if item.measure == "nrmse":
        return what, f"{simulated}, where {measured}"
    return what, f"simulated {simulated}, measured {measured}"
