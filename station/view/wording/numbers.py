"""Numbers as people read them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from station.diagnose.result import Estimate

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits, a dash for None; words for what is not finite."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "infinite" if math.isinf(value) else "undefined"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_SUPERSCRIPT)}".replace("-", "−")
    decimals = digits - 1 - (math.floor(math.log10(abs(value))) if value else digits - 1)
    return f"{value:.{max(decimals, 0)}f}".replace("-", "−")


def decimal(value: float) -> str:
    """Two decimals, never a negative zero."""
    return f"{round(value, 2) + 0.0:.2f}".replace("-", "−")


def percent(share: float | None) -> str:
    """A share as a percentage: ``0.03 %``, ``0.4 %``, ``41 %``; a dash for None."""
    if share is None or not math.isfinite(share):
        return "–"
    value = 100.0 * share
    decimals = 0 if abs(value) >= 9.95 or value == 0.0 else 1 if abs(value) >= 0.095 else 2
    return f"{round(value, decimals) + 0.0:.{decimals}f} %".replace("-", "−")


def resamples(value: float) -> str:
    """A share of resamples: ``all resamples``, ``93 % of the resamples``."""
    return "all resamples" if value > 0.995 else f"{percent(value)} of the resamples"


def probability(value: float) -> str:
    """A probability as a percentage that never rounds to certainty."""
    if value < 0.001:
        return "< 0.1 %"
    if value > 0.999:
        return "> 99.9 %"
    if value > 0.99:
        return f"{100.0 * value:.1f} %"
    return percent(value)


def unit_of(estimate: Estimate) -> str:
    """The unit as it is written behind a number: none for a pure number."""
    return "" if estimate.unit == "1" else estimate.unit


def digits_of(estimate: Estimate) -> int:
    """Significant digits that an estimate's interval deserves, three where it has none."""
    low, high, value = estimate.low, estimate.high, estimate.value
    if not (math.isfinite(high - low) and high > low and value):
        return 3
    return min(6, max(2, 2 + math.floor(math.log10(abs(value)) - math.log10((high - low) / 2.0))))


def interval(estimate: Estimate) -> str:
    """``0.0210 N m (0.0191 to 0.0229)``, as many digits as the interval deserves."""
    low, high, value, digits = estimate.low, estimate.high, estimate.value, digits_of(estimate)
    unit = f" {unit_of(estimate)}" if unit_of(estimate) else ""
    differs = "" if estimate.spread is None else f", from run to run ± {number(estimate.spread, 2)}"
    return f"{number(value, digits)}{unit} ({number(low, digits)} to {number(high, digits)}{differs})"
