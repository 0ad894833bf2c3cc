"""The blind campaign: rigs of the independent generator, each with something hidden or nothing, diagnosed unseen.

    python scripts/bench/blind.py --out blind [--cases 520] [--first-seed 20000] [--effort full] [--workers 2]
                                  [--sum-up] [--only clear subtle clean pair outside]
                                  [--hidden dead_zone hardening_spring@clamp]

Case i has the seed first-seed + i and five to eight runs.  Clear and subtle single causes (every effect of the
catalogue at each of its places, every constant of the rig), clean rigs, pairs of clear causes and rigs with something
outside the catalogue follow one another in fixed proportions, so that the first N cases are a fair sample of all, and
a longer campaign goes on where a shorter one ended.  One file per case is kept; a case that is there already, done by
the very code of this checkout, is not done again: a campaign may be stopped and taken up.  Constants that no size
makes visible are listed, not counted.

The table goes to standard output as Markdown, the same numbers to summary.json and each case's line to standard error.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from station.campaign.order import by_share, in_turn  # noqa: E402
from station.campaign.outcome import Key, Outcome, Task  # noqa: E402
from station.campaign.program import sources_hash  # noqa: E402
from station.campaign.run import Results, run_campaign, so_far  # noqa: E402
from station.campaign.summary import calibration, coverage, largest, median, share, summary, title  # noqa: E402
from tests.diagnose.blind import Cause, blind_task, judge, table  # noqa: E402
from tests.truth import SFLR, effect_names, outside_names, uncertain_keys  # noqa: E402
from tests.truth.sizes import BANDS, largest_parameter  # noqa: E402

MIX = {"clear": 128, "subtle": 128, "clean": 102, "pair": 82, "outside": 62}
"""Cases of each class in about 500: every cause three times clear and three times subtle, some of them unmade."""
CLOCK = ("clock_scale", "clock")
"""Not sized: host times, which every case with it has, always show it plainly."""
EQUIVALENT = {("input_delay", "amplifier"), ("parameter:motor.gain", "")}
"""Causes that others imitate exactly: late sensors together, the torque's scale.  The verdict must be `ambiguous`.
A clock that is off, too, without host times, which these cases have."""
PLAIN = {f"parameter:{key}" for key in ("drive.stiffness", "base.inertia", "clamp.stiffness", "beam.length",
                                          "accelerometer.gain")}
"""Constants that pairs may hold: on most rigs some size of these is clear, of the others on few or none."""
INSEPARABLE = (
    {"coulomb_friction@motor", "stribeck_friction@motor"},          # their levels add to one law's
    {"encoder_delay@encoder", "accelerometer_delay@accelerometer"},  # together an input delay
    {"command_bias@amplifier", "cable_spring@base"},                # a constant torque moves the spring's rest
)
"""Pairs that are not hidden: one cause does what the two do."""


def code_hash() -> str:
    """What the cases depend on beyond the package: the generator and the judge."""
    return sources_hash([ROOT / "tests/truth", ROOT / "tests/diagnose/blind.py"])


def causes(band: str) -> tuple[list[Cause], dict[str, str]]:
    """Every cause that can have a severity in the band, and why the others cannot."""
    found: list[Cause] = [key for key in effect_names(SFLR) if band == "clear" or key != CLOCK]
    never = {} if band == "clear" else {title(CLOCK): "not sized; counted with the clear ones"}
    for key in uncertain_keys(SFLR):
        name = f"parameter:{key}"
        most = largest_parameter(name, SFLR) ** 2
        if most < BANDS[band][0]:
            never[name] = f"moved as far as is physical it costs its own uncertainty {most:.0f} of chi squared"
        else:
            found.append((name, None))
    return found, never


def pairs(items: Sequence[Cause], rng: np.random.Generator) -> Iterator[list[Cause]]:
    """Two different effects, or an effect and a constant; every cause as often as any other."""
    first, second = in_turn([c for c in items if ":" not in c[0]], rng), in_turn(items, rng)
    for one in first:
        other = next(second)
        while other[0] == one[0] or {title((e, at or "")) for e, at in (one, other)} in INSEPARABLE:
            other = items[rng.integers(len(items))]
        yield [one, other]


def campaign(first_seed: int, effort: str, only: Sequence[str], chosen: Sequence[Cause]) -> Iterator[Task]:
    """Cases without end."""
    rng = np.random.default_rng([first_seed, 0xB11D])
    singles = {band: [c for c in causes(band)[0] if not chosen or c in chosen] for band in BANDS}
    plain = [c for c in causes("clear")[0] if c != CLOCK and (":" not in c[0] or c[0] in PLAIN)]
    hidden: dict[str, Iterator[list[Cause]]] = {
        **{band: ([c] for c in in_turn(singles[band], rng)) for band in BANDS},
        "clean": iter(lambda: [], None), "pair": pairs(plain, rng),
        "outside": ([(name, None)] for name in in_turn(outside_names(SFLR), rng))}
    weights = {name: MIX[name] for name in MIX if name in only and singles.get(name, True)}
    for i, name in enumerate(by_share(weights)):
        band = {"clear": "clear", "subtle": "subtle", "pair": "clear"}.get(name)
        yield blind_task(first_seed + i, next(hidden[name]), effort=effort, runs=None, band=band, group=name)


def figures(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """What was wanted and what was found, row by row; shares with their Wilson intervals."""
    of: dict[str, list[Outcome]] = {name: [o for o in outcomes if o.group == name] for name in MIX}
    inside = of["clear"] + of["subtle"] + of["pair"]
    alone = [o for o in of["clear"] if not o.keys & EQUIVALENT]

    def both(o: Outcome) -> bool:
        return o.keys <= set(o.said)

    def listed(o: Outcome) -> bool:
        return o.keys <= {*o.said, *o.rivals}

    rows: list[tuple[str, str, Callable[[float], bool] | None, dict[str, Any]]] = [
        ("clear single causes named first", "95 %", lambda x: x >= 0.95, share(o.named for o in of["clear"])),
        ("… named or a listed rival", "", None, share(o.listed for o in of["clear"])),
        ("subtle ones named first", "75 %", lambda x: x >= 0.75, share(o.named for o in of["subtle"])),
        ("… named or a listed rival", "", None, share(o.listed for o in of["subtle"])),
        ("clean rigs accused", "≤ 2 %", lambda x: x <= 0.02, share(bool(o.causes) for o in of["clean"])),
        ("both causes of a pair found", "80 %", lambda x: x >= 0.8, share(map(both, of["pair"]))),
        ("… found or listed rivals", "", None, share(map(listed, of["pair"]))),
        ("outside the catalogue, wrongly `explained`", "≤ 10 %", lambda x: x <= 0.1,
         share(o.verdict == "explained" for o in of["outside"])),
        ("… something accused under any verdict", "", None, share(bool(o.causes) for o in of["outside"])),
        ("`ambiguous` on single clear causes without a known equivalence", "≤ 10 %", lambda x: x <= 0.1,
         share(o.verdict == "ambiguous" for o in alone)),
        ("`ambiguous` on single clear causes with one", "", None,
         share(o.verdict == "ambiguous" for o in of["clear"] if o.keys & EQUIVALENT)),
        ("`ambiguous`, all cases", "", None, share(o.verdict == "ambiguous" for o in outcomes)),
        ("something else accused beside a right single cause", "", None,
         share(bool(set(o.said) - o.keys) for o in of["clear"] + of["subtle"] if o.named)),
        ("truth inside the stated 95 % interval", "88–99 %", lambda x: 0.88 <= x <= 0.99,
         share(held for o in inside for _, _, held in o.intervals())),
    ]
    return [{"what": what, "wanted": wanted, **found,
             "met": None if test is None or found["share"] is None else bool(test(found["share"]))}
            for what, wanted, test, found in rows]


def numbers(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """The figures that are no shares."""
    inside = [o for o in outcomes if o.group in ("clear", "subtle", "pair")]
    five = [o for o in outcomes if o.runs == 5]
    rows: list[tuple[str, str, Callable[[float], bool] | None, float | None, int]] = []
    for what, kind, test in (("calibration error, every cause ranked", "ranked", lambda x: x <= 0.05),
                             ("… every cause and rival stated", "stated", lambda x: x <= 0.05)):
        found = calibration(pair for o in outcomes for pair in getattr(o, kind)())
        rows.append((what, "≤ 0.05", test, found["error"], found["statements"]))
    fractions = [o.gain.get("explained_fraction") for o in inside]
    rows += [
        ("share of the explainable error removed on unseen runs, median", "0.9", lambda x: x >= 0.9, median(fractions),
         sum(f is not None for f in fractions)),
        ("seconds per diagnosis of five runs, median", "", None, median(o.seconds for o in five), len(five)),
        ("… largest", "", None, largest(o.seconds for o in five), len(five)),
        ("seconds per diagnosis, all cases, median", "", None, median(o.seconds for o in outcomes), len(outcomes)),
        ("… largest", "", None, largest(o.seconds for o in outcomes), len(outcomes)),
        ("CPU seconds per diagnosis, median", "", None, median(o.cpu for o in outcomes), len(outcomes)),
        ("seconds to make a case, median", "", None, median(o.making for o in outcomes), len(outcomes)),
        ("peak memory of a worker, generator included, MB", "< 2000", lambda x: x < 2000,
         largest(o.peak_mb for o in outcomes), len(outcomes)),
    ]
    return [{"what": what, "wanted": wanted, "value": value, "of": of,
             "met": None if test is None or value is None else bool(test(value))}
            for what, wanted, test, value, of in rows]


def markdown(shares: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]], bins: Sequence[dict[str, Any]]) -> str:
    """The tables of the docs."""
    met = {None: "", True: "yes", False: "**no**"}
    lines = ["| what | wanted | found | 95 % interval | cases | met |", "| --- | --- | --- | --- | --- | --- |"]
    for row in shares:
        found, interval = "–", ""
        if row["of"]:
            found, interval = f"{100 * row['share']:.1f} %", f"{100 * row['low']:.1f}–{100 * row['high']:.1f} %"
        lines.append(f"| {row['what']} | {row['wanted']} | {found} | {interval} | {row['count']} of {row['of']} | "
                     f"{met[row['met']]} |")
    for row in others:
        found = "–" if row["value"] is None else f"{row['value']:.3g}" if row["value"] < 100 else f"{row['value']:.0f}"
        lines.append(f"| {row['what']} | {row['wanted']} | {found} | | {row['of']} | {met[row['met']]} |")
    lines += ["", "| stated probability | on average | came true | 95 % interval | statements |",
              "| --- | --- | --- | --- | --- |"]
    lines += [f"| {b['from']:.1f}–{b['to']:.1f} | {b['stated']:.3f} | {b['share']:.3f} | "
              f"{b['low']:.3f}–{b['high']:.3f} | {b['of']} |" for b in bins]
    return "\n".join(lines)


def by_cause(outcomes: Sequence[Outcome]) -> str:
    """Markdown: how often each single cause was named first, clear and subtle."""
    counts: dict[Key, dict[str, list[bool]]] = {}
    for o in outcomes:
        if o.group in BANDS:
            counts.setdefault(next(iter(o.keys)), {band: [] for band in BANDS})[o.group].append(o.named)
    lines = ["| cause | " + " | ".join(f"{band}, named first" for band in BANDS) + " |",
             "| --- |" + " --- |" * len(BANDS)]
    lines += [f"| `{title(key)}` | " + " | ".join(f"{sum(n)} of {len(n)}" for n in row.values()) + " |"
              for key, row in sorted(counts.items())]
    return "\n".join(lines)


def by_parameter(outcomes: Sequence[Outcome]) -> str:
    """Markdown: how many intervals of each parameter hold the truth."""
    lines = ["| parameter | 95 % intervals that hold the truth |", "| --- | --- |"]
    lines += [f"| `{name}` | {found['count']} of {found['of']} |" for name, found in coverage(outcomes).items()]
    return "\n".join(lines)


def report(results: Results, out: Path, arguments: dict[str, Any]) -> str:
    """Write summary.json and give the Markdown."""
    outcomes = [o for o in results.outcomes if o.unmade is None]
    whole = summary(results)
    shares, others = figures(outcomes), numbers(outcomes)
    never = {f"{band}: {name}": why for band in BANDS for name, why in causes(band)[1].items()}
    out.joinpath("summary.json").write_text(json.dumps(
        {"arguments": arguments, **whole, "figures": shares, "numbers": others, "never": never}, indent=1),
        encoding="utf-8")
    unmade = {**never, **whole["unmade"]}
    parts = [markdown(shares, others, whole["calibration"]["ranked"]["bins"]), by_cause(outcomes),
             by_parameter(outcomes)]
    if unmade:
        parts.append("Not counted:\n\n" + "\n".join(f"- {name}: {why}" for name, why in unmade.items()))
    if results.failed:
        parts.append("Failed:\n\n" + "\n".join(f"- {name}: {why}" for name, why in results.failed.items()))
    sizes = {name: sum(o.group == name for o in outcomes) for name in MIX}
    head = f"{len(outcomes)} cases ({', '.join(f'{count} {name}' for name, count in sizes.items())}), " \
           f"first seed {arguments['first_seed']}, effort {arguments['effort']}, {arguments['workers']} workers."
    return "\n\n".join([head, *parts])


def main() -> int:
    """Do what is not done yet, then sum up all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=520)
    parser.add_argument("--first-seed", type=int, default=20000)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--effort", choices=["quick", "full"], default="full")
    parser.add_argument("--only", nargs="+", choices=list(MIX), default=list(MIX), help="only these classes")
    parser.add_argument("--hidden", nargs="+", default=[], metavar="EFFECT[@AT]", help="only these single causes")
    parser.add_argument("--sum-up", action="store_true", help="do nothing, sum up what is there")
    options = parser.parse_args()
    places = {title((e, at or "")): (e, at) for band in BANDS for e, at in causes(band)[0]}
    names = [n for text in options.hidden for n in places if text in (n, n.partition("@")[0])]
    if options.hidden and not names:
        parser.error(f"--hidden: none of {', '.join(places)}")
    tasks = list(islice(campaign(options.first_seed, options.effort, options.only, [places[n] for n in names]),
                        options.cases))
    options.out.mkdir(parents=True, exist_ok=True)
    done = 0

    def begun(there: int, left: int) -> None:
        nonlocal done
        done = there
        print(f"{there} cases are there, {left} to do", file=sys.stderr, flush=True)

    def told(task: Task, found: Outcome | str) -> None:
        nonlocal done
        done += 1
        line = f"{task.label}: {found}" if isinstance(found, str) else table([found]).splitlines()[1]
        print(f"{done:4d}/{len(tasks)} {line}", file=sys.stderr, flush=True)

    results = None
    try:
        if not options.sum_up:
            results = run_campaign(tasks, judge, options.out, workers=options.workers, code=code_hash(), told=told,
                                   begun=begun)
    except KeyboardInterrupt:
        print("interrupted: the table is of what is there; the same command goes on", file=sys.stderr, flush=True)
    if results is None:
        results = so_far(tasks, options.out, code=code_hash())
    print(report(results, options.out, {key: str(value) if isinstance(value, Path) else value
                                        for key, value in vars(options).items()}))
    return 1 if results.failed else 0


if __name__ == "__main__":
    sys.exit(main())
