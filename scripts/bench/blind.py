"""The blind campaign: many rigs with something hidden, or nothing, each diagnosed from five runs.

    python scripts/bench/blind.py --out blind [--cases 100] [--first-seed 2000] [--workers 2] [--effort full]
                                  [--hidden dead_zone coulomb_friction@base parameter:tip.mass ...] [--outside]

Case i has the seed first-seed + i.  Every fifth is a clean rig; the others hide the causes of the list (by default
every effect of the catalogue at each of its places) in turn.  One file per case is kept in the folder; a case that is
there already, done by the very code of this checkout, is not done again: a campaign may be stopped and taken up.
Prints the table, the shares with their 95 % Wilson intervals, how often an interval holds the truth, and how far
stated probabilities are from what came true; the same numbers go to summary.json.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.diagnose.blind import Outcome, Task, judge, plain, table  # noqa: E402
from tests.truth import SFLR, effect_names, outside_names  # noqa: E402

BINS = np.linspace(0.0, 1.0, 11)


def code_hash() -> str:
    """What the answers depend on: the program's and the generator's sources."""
    digest = hashlib.sha256()
    for folder in ("station", "tests/truth", "tests/diagnose"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".toml") and (folder != "tests/diagnose" or path.name == "blind.py"):
                digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def tasks(cases: int, first_seed: int, hidden: Sequence[tuple[str, str | None]], effort: str) -> list[Task]:
    """Every fifth case clean, the others through the list in turn."""
    found, turn = [], 0
    for i in range(cases):
        if i % 5 == 4:
            found.append(Task(first_seed + i, None, None, effort))
        else:
            found.append(Task(first_seed + i, *hidden[turn % len(hidden)], effort))
            turn += 1
    return found


def attempt(task: Task) -> Outcome | str:
    """The outcome, or in one line why there is none."""
    try:
        return judge(task)
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]


def share(true: Sequence[bool]) -> dict[str, Any]:
    """Counts, and the 95 % Wilson interval of the share."""
    k, n = int(sum(true)), len(true)
    if not n:
        return {"of": 0, "count": 0}
    interval = binomtest(k, n).proportion_ci(0.95, "wilson")
    return {"of": n, "count": k, "share": k / n, "low": interval.low, "high": interval.high}


def calibration(pairs: Sequence[tuple[float, bool]]) -> dict[str, Any]:
    """Expected calibration error: mean over the statements of |stated - came true| of their tenth."""
    stated, true = np.array([p for p, _ in pairs]), np.array([t for _, t in pairs], dtype=float)
    tenth = np.clip(np.digitize(stated, BINS) - 1, 0, len(BINS) - 2)
    rows = [{"from": float(BINS[b]), "statements": int(np.sum(tenth == b)), "stated": float(stated[tenth == b].mean()),
             "true": float(true[tenth == b].mean())} for b in np.unique(tenth)]
    error = sum(row["statements"] * abs(row["stated"] - row["true"]) for row in rows)
    return {"statements": len(pairs), "error": error / len(pairs) if pairs else None, "bins": rows}


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All the figures of a campaign."""
    inside = [o for o in outcomes if not o.clean and not o.outside]
    seconds = [o.seconds for o in outcomes]
    return {
        "named first": share([o.named for o in inside]),
        "named at all": share([any((c["effect"], c["at"]) in o.keys for c in o.causes) for o in inside]),
        "something else accused beside it": share(
            [any((c["effect"], c["at"]) not in o.keys for c in o.causes) for o in inside if o.named]),
        "clean rigs accused": share([bool(o.causes) for o in outcomes if o.clean]),
        "rigs with an unknown effect accused": share([bool(o.causes) for o in outcomes if o.outside]),
        "named and better on held-out runs": share([o.better for o in inside if o.named]),
        "intervals that hold the truth": share([held for o in outcomes for _, held in o.intervals()]),
        "calibration": calibration([pair for o in outcomes for pair in o.stated()]),
        "seconds": {"median": float(np.median(seconds)), "largest": max(seconds)} if seconds else {},
    }


def show(found: dict[str, Any], outcomes: Sequence[Outcome], failed: dict[str, str]) -> None:
    """The table and the figures as lines."""
    print(table(sorted(outcomes, key=lambda o: o.label)))
    for label, why in sorted(failed.items()):
        print(f"{label:40s} no outcome: {why}")
    for name, value in found.items():
        if "share" in value:
            print(f"{name}: {value['count']} of {value['of']}, {100 * value['share']:.1f} % "
                  f"({100 * value['low']:.1f} to {100 * value['high']:.1f})")
    if found["calibration"]["statements"]:
        print(f"calibration error {found['calibration']['error']:.3f} over {found['calibration']['statements']} "
              "stated probabilities")
        for row in found["calibration"]["bins"]:
            print(f"  {row['statements']:4d} said {row['stated']:.2f} on average, {row['true']:.2f} true")
    if found["seconds"]:
        print(f"{found['seconds']['median']:.1f} s per diagnosis, {found['seconds']['largest']:.1f} s the longest")


def main() -> int:
    """Do what is not done yet, then sum up all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--effort", choices=["quick", "full"], default="full")
    parser.add_argument("--hidden", nargs="+", metavar="EFFECT[@AT]", help="what to hide, instead of the catalogue")
    parser.add_argument("--outside", action="store_true", help="hide effects outside the catalogue, too")
    options = parser.parse_args()
    hidden: list[tuple[str, str | None]] = [(name, at or None) for name, _, at in
                                            (text.partition("@") for text in options.hidden or [])]
    if not hidden:
        hidden = list(effect_names(SFLR))
    if options.outside:
        hidden += [(name, None) for name in outside_names(SFLR)]
    options.out.mkdir(parents=True, exist_ok=True)
    code, outcomes, failed, left = code_hash(), [], {}, []
    for task in tasks(options.cases, options.first_seed, hidden, options.effort):
        path = options.out / f"{task.label.replace(':', '-')}.json"
        kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if kept.get("code") == code:
            outcomes.append(Outcome(**kept["outcome"]))
        else:
            left.append((task, path))
    print(f"{len(outcomes)} cases are there, {len(left)} to do", flush=True)
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(attempt, task): (task, path) for task, path in left}
        for done in as_completed(futures):
            task, path = futures[done]
            outcome = done.result()
            if isinstance(outcome, str):
                failed[task.label] = outcome
                print(f"{task.label}: {outcome}", flush=True)
                continue
            outcomes.append(outcome)
            path.write_text(json.dumps({"code": code, "outcome": plain(outcome)}, indent=1), encoding="utf-8")
            print(table([outcome]).splitlines()[1], flush=True)
    found = summary(outcomes)
    show(found, outcomes, failed)
    (options.out / "summary.json").write_text(json.dumps({"code": code, "failed": failed, **found}, indent=1),
                                              encoding="utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
