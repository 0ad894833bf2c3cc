"""How many tests an investigation needs, beside a fixed battery of six, on the same hidden rigs.

    python scripts/bench/investigate.py --out investigate [--cases 40] [--first-seed 7000] [--workers 2]
                                        [--effort full] [--budget 8] [--hidden backlash dead_zone@amplifier ...]

Case i has the seed first-seed + i.  Every fifth is a clean rig; the others hide the causes of the list (by default
the catalogue's effects) in turn, sized so that they are clear in the tests that the generator draws.  Rig, effect and
simulation are those of the independent generator (`tests.truth`); the investigator sees the runs of the tests that it
asks for and the nominal rig, nothing else.  The battery is BATTERY, the same six tests for every case, diagnosed once.
Both start every run from the same small random angle and offset about zero, with the case's noise.

Right is, with something hidden, that it is the first cause named; on a clean rig, that none is named.  An investigation
that ends undecided and names nothing is wrong where something is hidden.  Wanted: a median of at most 60 % of the
battery's runs, at no less accuracy.  One file per case is kept; a case that is there already, done by the very code of
this checkout, is not done again.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from station.control.named import NAMED  # noqa: E402
from station.control.references import reference_from_test  # noqa: E402
from station.runs.run import Run, RunMetadata  # noqa: E402
from tests.truth import SFLR, Case, Truth, effect_names, make_case  # noqa: E402

BATTERY: tuple[dict[str, Any], ...] = (
    {"kind": "pulse", "amplitude": 100.0, "controller": NAMED["open"]},
    {"kind": "pulse", "amplitude": 40.0, "controller": NAMED["open"]},
    {"kind": "step", "amplitude": 50.0, "controller": NAMED["p"]},
    {"kind": "step", "amplitude": 100.0, "controller": NAMED["lead"]},
    {"kind": "step", "amplitude": 200.0, "controller": NAMED["lead-accel"]},
    {"kind": "sweep", "amplitude": 40.0, "f1": 20.0, "duration": 12.0, "controller": NAMED["p"]},
)
"""The kinds and sizes of the laboratory's own logs, and a smaller pulse."""
WANTED = 0.6
CASES, FIRST_SEED, DRAWS = 40, 7000, 5
Hidden = tuple[str, str | None]


def drawn(seed: int, wanted: list[Any]) -> Case:
    """The case of a seed, or where no size on that rig is clear, of the first further one whose is."""
    for attempt in range(DRAWS):
        try:
            return make_case(seed + attempt * 100_000, wanted, count=5, band="clear")
        except ValueError as error:
            reason = error
    raise ValueError(reason)


def device(seed: int, hidden: Hidden | None) -> tuple[Callable[[dict[str, Any], dict[str, Any]], Run], dict[str, Any]]:
    """The rig of a case as something that runs tests, and what is hidden in it."""
    wanted = [] if hidden is None else [(hidden[0], hidden[1]) if hidden[1] else hidden[0]]
    case = drawn(seed, wanted)
    truth = Truth(case.rig, case.effects)
    rng = np.random.default_rng([seed, 0x1A])
    sigma = case.conditions[0].accel_sigma
    ratio = next((e["ratio"] for e in case.effects if e["effect"] == "clock_scale"), 1.0)
    made = 0

    def run_test(test: dict[str, Any], controller: dict[str, Any]) -> Run:
        nonlocal made
        made += 1
        reference = np.floor(reference_from_test(test, SFLR["sample_rate"]) + 0.5)
        out = truth.run(reference, controller, start="released", start_angle=float(rng.normal(0.0, 0.002)),
                        gap_place=float(rng.uniform(-1.0, 1.0)), zero_angle=0.0,
                        accel_offset=float(rng.normal(0.0, 1.5)), accel_sigma=sigma, rounding=True, rng=rng)
        late = float(rng.uniform(0.0, 1e4)) + rng.exponential(2e-4, len(out.t))
        metadata = RunMetadata(rig="sflr", controller=controller, test=test, zero_id="bench", start="released",
                               command_row=-1, accel_zero=out.accel_zero)
        return Run(name=f"{made:02d}-{test['kind']}-{controller['kind']}", t=out.t, reference=out.reference,
                   command=out.command, encoder=out.encoder, accel=out.accel, metadata=metadata,
                   n=np.arange(len(out.t), dtype=float), device_time=out.t.copy(), host_time=out.t * ratio + late)

    return run_test, {"causes": case.truth["causes"], "severity": list(case.truth["severity"].values())}


def judged(result: Any, causes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What a diagnosis says and whether it is right."""
    said = result.diagnosis
    first = said.causes[0] if said.causes else None
    truth = {(cause["effect"], cause["at"]) for cause in causes}
    right = (first.effect, first.at) in truth if truth and first else not truth and first is None
    return {"verdict": said.verdict, "right": bool(right), "accused": first is not None,
            "named": [f"{c.effect}@{c.at} {c.probability:.3f}" for c in said.causes]}


def task(seed: int, hidden: Hidden | None, effort: str, budget: int) -> dict[str, Any]:
    """One case: the investigation, then the battery."""
    from station.diagnose.diagnose import diagnose
    from station.diagnose.investigate import investigate
    from station.rig import load_rig

    rig = load_rig("sflr")
    run_test, truth = device(seed, hidden)
    begun = time.perf_counter()
    found = investigate(rig, run_test, partial(diagnose, effort=effort, threads=1), budget=budget)
    steps = [{"test": step.run.metadata.test, "controller": step.run.metadata.controller["kind"],
              **judged(step.result, truth["causes"])} for step in found.steps]
    adaptive = {"runs": len(found.steps), "outcome": found.outcome, "why": found.why, "steps": steps,
                "test_seconds": float(sum(run.t[-1] for run in found.runs)), "seconds": time.perf_counter() - begun,
                **judged(found.result, truth["causes"])}
    run_test, _ = device(seed, hidden)
    runs = [run_test({k: v for k, v in test.items() if k != "controller"}, test["controller"]) for test in BATTERY]
    begun = time.perf_counter()
    fixed = judged(diagnose(rig, runs, effort=effort, threads=1), truth["causes"])
    fixed |= {"runs": len(runs), "test_seconds": float(sum(run.t[-1] for run in runs)),
              "seconds": time.perf_counter() - begun}
    return {"seed": seed, "hidden": hidden, "truth": truth, "adaptive": adaptive, "fixed": fixed}


def attempt(*given: Any) -> dict[str, Any] | str:
    """The outcome of a case, or in one line why there is none."""
    try:
        return task(*given)
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]


def share(true: Sequence[bool]) -> str:
    """A share and its 95 % Wilson interval."""
    if not true:
        return "none"
    interval = binomtest(int(sum(true)), len(true)).proportion_ci(0.95, "wilson")
    return (f"{sum(true)} of {len(true)}, {100 * sum(true) / len(true):.0f} % "
            f"({100 * interval.low:.0f} to {100 * interval.high:.0f})")


def line(done: dict[str, Any]) -> str:
    """One case in one line."""
    a, f = done["adaptive"], done["fixed"]
    name = "@".join(x for x in done["hidden"] if x) if done["hidden"] else "clean"
    return (f"{done['seed']:6d} {name:32s} {a['runs']} runs {a['outcome']:8s} {a['verdict']:16s} "
            f"{'right' if a['right'] else 'WRONG':5s} {', '.join(a['named'][:2]) or '-':44s} | battery "
            f"{f['verdict']:16s} {'right' if f['right'] else 'WRONG':5s} {', '.join(f['named'][:2]) or '-'}")


def summary(done: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all cases, printed and kept."""
    print(f"battery: {', '.join(_words(test) for test in BATTERY)}")
    hidden, clean = [d for d in done if d["hidden"]], [d for d in done if not d["hidden"]]
    shares = {}
    for way in ("adaptive", "fixed"):
        rows = {"right": [d[way]["right"] for d in done], "named first": [d[way]["right"] for d in hidden],
                "clean not accused": [d[way]["right"] for d in clean]}
        shares[way] = {name: [int(sum(values)), len(values)] for name, values in rows.items()}
        for name, values in rows.items():
            print(f"{way:8s} {name:18s} {share(values)}")
    early = [d for d in done if not d["adaptive"]["right"] and d["adaptive"]["outcome"] == "decided"]
    print(f"decided and wrong: {share([d in early for d in done])}")
    medians = {way: float(np.median([d[way]["runs"] for d in done])) for way in ("adaptive", "fixed")}
    lengths = {way: float(np.median([d[way]["test_seconds"] for d in done])) for way in ("adaptive", "fixed")}
    counts = np.bincount([d["adaptive"]["runs"] for d in done])
    print(f"runs: median {medians['adaptive']:g} against {medians['fixed']:g}, mean "
          f"{np.mean([d['adaptive']['runs'] for d in done]):.2f}; "
          + ", ".join(f"{n} runs: {count}" for n, count in enumerate(counts) if count))
    print(f"seconds of testing: median {lengths['adaptive']:.1f} against {lengths['fixed']:.1f}")
    few = medians["adaptive"] <= WANTED * medians["fixed"]
    good = shares["adaptive"]["right"][0] >= shares["fixed"]["right"][0]
    print(f"wanted: runs <= {WANTED:.0%}: {'met' if few else 'NOT MET'}; right no less often: "
          f"{'met' if good else 'NOT MET'}")
    return {"shares": shares, "runs": medians, "test_seconds": lengths, "met": few and good}


def _words(test: dict[str, Any]) -> str:
    return f"{test['kind']} {test['amplitude']:g} ({test['controller']['kind']})"


def main() -> int:
    """Do what is not done yet, then sum up all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--effort", choices=["quick", "full"], default="full")
    parser.add_argument("--budget", type=int, default=8)
    parser.add_argument("--hidden", nargs="+", metavar="EFFECT[@AT]", help="what to hide, instead of the catalogue")
    options = parser.parse_args()
    pool: list[Hidden] = [(name, at or None) for name, _, at in
                          (text.partition("@") for text in options.hidden or [])] or list(effect_names(SFLR))
    options.out.mkdir(parents=True, exist_ok=True)
    code, done, failed, left, turn = _code(), [], {}, [], 0
    for i in range(options.cases):
        seed, hidden = options.first_seed + i, None
        if i % 5 != 4:
            hidden = pool[turn % len(pool)]
            turn += 1
        name = re.sub(r"[^\w.-]", "-", "-".join(x for x in hidden if x) if hidden else "clean")
        path = options.out / f"{seed}-{name}-{options.effort}-{options.budget}.json"
        kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if kept.get("code") == code:
            done.append(kept["outcome"])
        else:
            left.append((path, (seed, hidden, options.effort, options.budget)))
    print(f"{len(done)} cases are there, {len(left)} to do", flush=True)
    for outcome in done:
        print(line(outcome))
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as workers:
        futures = {workers.submit(attempt, *given): (path, given) for path, given in left}
        for future in as_completed(futures):
            path, given = futures[future]
            outcome = future.result()
            if isinstance(outcome, str):
                failed[path.stem] = outcome
                print(f"{path.stem}: no outcome: {outcome}", flush=True)
                continue
            path.write_text(json.dumps({"code": code, "outcome": outcome}, indent=1), encoding="utf-8")
            done.append(outcome)
            print(line(outcome), flush=True)
    if not done:
        return 1
    found = summary(done)
    (options.out / "summary.json").write_text(json.dumps({"code": code, "failed": failed, **found}, indent=1),
                                              encoding="utf-8")
    return 1 if failed or not found["met"] else 0


def _code() -> str:
    """What the answers depend on: the program's, the generator's and this file's sources."""
    import hashlib

    digest = hashlib.sha256(Path(__file__).read_bytes())
    for folder in ("station", "tests/truth"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    sys.exit(main())
