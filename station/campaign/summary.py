"""What the cases of a campaign say together, as plain values."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from station.campaign.outcome import Outcome
from station.campaign.run import Results
from station.estimation.cause import Key

SCHEMA = "station-campaign/1"
BINS = np.linspace(0.0, 1.0, 11)


def title(key: Key) -> str:
    """``coulomb_friction@motor``, ``parameter:tip.mass``."""
    return f"{key[0]}@{key[1]}" if key[1] else key[0]


def share(true: Iterable[bool]) -> dict[str, Any]:
    """Count, and the share with its 95 % Wilson interval; None where there is nothing to count."""
    true = list(true)
    k, n = int(sum(true)), len(true)
    if not n:
        return {"count": 0, "of": 0, "share": None, "low": None, "high": None}
    interval = binomtest(k, n).proportion_ci(0.95, "wilson")
    return {"count": k, "of": n, "share": k / n, "low": float(interval.low), "high": float(interval.high)}


def calibration(pairs: Iterable[tuple[float, bool]]) -> dict[str, Any]:
    """Expected calibration error, and per tenth what was stated on average and how much of it was true.

    The error is the mean over all statements of |stated - true| of their tenth.
    """
    pairs = list(pairs)
    stated, true = np.array([p for p, _ in pairs]), np.array([t for _, t in pairs], dtype=bool)
    tenth = np.clip(np.digitize(stated, BINS) - 1, 0, len(BINS) - 2)
    rows = [{"from": float(BINS[b]), "to": float(BINS[b + 1]), "stated": float(stated[tenth == b].mean()),
             **share(true[tenth == b].tolist())} for b in np.unique(tenth)]
    error = sum(row["of"] * abs(row["stated"] - row["share"]) for row in rows) / len(pairs) if pairs else None
    return {"statements": len(pairs), "error": error, "bins": rows}


def confusion(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """How often each thing that was hidden (rows) was met by each first named cause, or verdict without one (columns).

    Rows: every cause that was hidden alone, then clean rigs, rigs with several causes, rigs with something that is
    outside the catalogue.  Cases of which nobody knows what is hidden are not in it.
    """
    counts: Counter[tuple[str, str]] = Counter()
    for outcome in outcomes:
        if outcome.hidden is not None:
            counts[_hidden(outcome), title(outcome.said[0]) if outcome.causes else outcome.verdict] += 1
    last = ("clean", "several causes", "outside the catalogue")
    singles = sorted({row for row, _ in counts} - set(last))
    rows = singles + [row for row in last if any(row == key[0] for key in counts)]
    causes = {title(outcome.said[0]) for outcome in outcomes if outcome.causes and outcome.hidden is not None}
    columns = [row for row in singles if row in causes] + sorted(causes - set(singles))
    columns += sorted({column for _, column in counts} - causes)
    return {"rows": rows, "columns": columns, "counts": [[counts[row, column] for column in columns] for row in rows]}


def _hidden(outcome: Outcome) -> str:
    if outcome.outside:
        return "outside the catalogue"
    keys = sorted(outcome.keys)
    return "clean" if not keys else title(keys[0]) if len(keys) == 1 else "several causes"


def shares(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """Every share that a campaign can tell, each with its interval."""
    known = [o for o in outcomes if o.hidden is not None]
    inside = [o for o in known if not o.clean and not o.outside]
    single = [o for o in inside if len(o.keys) == 1]
    several = [o for o in inside if len(o.keys) > 1]
    clean, outside = [o for o in known if o.clean], [o for o in known if o.outside]
    return {
        "single causes named first": share(o.named for o in single),
        "single causes named or listed as a rival": share(o.listed for o in single),
        "something else accused beside a right first cause": share(
            bool(set(o.said) - o.keys) for o in single if o.named),
        "all of several causes found": share(o.keys <= set(o.said) for o in several),
        "clean rigs accused": share(bool(o.causes) for o in clean),
        "outside the catalogue, explained all the same": share(o.verdict == "explained" for o in outside),
        "ambiguous": share(o.verdict == "ambiguous" for o in outcomes),
        "right first cause, better on held-out runs": share(o.better for o in inside if o.named),
        "95 % intervals that hold the truth": share(held for o in inside for _, _, held in o.intervals()),
    }


def coverage(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """Share of the 95 % intervals that hold the truth, by cause and parameter."""
    held: dict[str, list[bool]] = defaultdict(list)
    for outcome in outcomes:
        for key, name, inside in outcome.intervals():
            held[f"{title(key)} {name}"].append(inside)
    return {name: share(inside) for name, inside in sorted(held.items())}


def verdicts(outcomes: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """Verdicts by group."""
    found: dict[str, Counter[str]] = defaultdict(Counter)
    for outcome in outcomes:
        found[outcome.group][outcome.verdict] += 1
    return {group: dict(sorted(counts.items())) for group, counts in sorted(found.items())}


def gains(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Medians over the cases of each group: errors on held-out runs before and after, and the share explained."""
    rows = []
    for group in sorted({outcome.group for outcome in outcomes}):
        cases = [outcome for outcome in outcomes if outcome.group == group]
        row: dict[str, Any] = {"group": group, "cases": len(cases)}
        for channel in ("encoder", "accel"):
            pairs = [(before, after) for o in cases for name, before, after in o.errors if name == channel]
            row[channel] = {"nrmse_before": median(before for before, _ in pairs),
                            "nrmse_after": median(after for _, after in pairs)}
        row["explained_fraction"] = median(o.gain.get("explained_fraction") for o in cases)
        row["seconds"] = median(o.seconds for o in cases)
        rows.append(row)
    return rows


def median(values: Iterable[float | None]) -> float | None:
    """Of those that are there."""
    there = [value for value in values if value is not None]
    return float(np.median(there)) if there else None


def largest(values: Iterable[float | None]) -> float | None:
    """Of those that are there."""
    return max((value for value in values if value is not None), default=None)


def summary(results: Results) -> dict[str, Any]:
    """All of it; the cases themselves as a table of what matters."""
    outcomes = [outcome for outcome in results.outcomes if outcome.unmade is None]
    known = [outcome for outcome in outcomes if outcome.hidden is not None]
    return {
        "schema": SCHEMA,
        "cases": len(outcomes),
        "failed": results.failed,
        "unmade": {o.label: o.unmade for o in results.outcomes if o.unmade is not None},
        "verdicts": verdicts(outcomes),
        "confusion": confusion(outcomes),
        "shares": shares(outcomes),
        "coverage": coverage(outcomes),
        "calibration": {"stated": calibration(pair for o in known for pair in o.stated()),
                        "ranked": calibration(pair for o in known for pair in o.ranked())},
        "gains": gains(outcomes),
        "seconds": {"median": median(o.seconds for o in outcomes), "largest": largest(o.seconds for o in outcomes),
                    "cpu_median": median(o.cpu for o in outcomes), "making_median": median(o.making for o in outcomes)},
        "peak_mb": largest(o.peak_mb for o in outcomes),
        "table": [_row(outcome) for outcome in outcomes],
    }


def _row(outcome: Outcome) -> dict[str, Any]:
    return {
        "case": outcome.label, "group": outcome.group,
        "hidden": None if outcome.hidden is None else [title(key) for key in sorted(outcome.keys)],
        "severity": outcome.severity, "verdict": outcome.verdict,
        "causes": [{"cause": title((c["effect"], c["at"])), "probability": c["probability"],
                    "rivals": [title((r["effect"], r["at"])) for r in c["rivals"]]} for c in outcome.causes],
        "gain": {channel: {"nrmse_before": before, "nrmse_after": after} for channel, before, after in outcome.errors},
        "explained_fraction": outcome.gain.get("explained_fraction"), "seconds": outcome.seconds,
    }
