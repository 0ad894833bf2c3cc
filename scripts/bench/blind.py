"""The blind campaign: rigs of the independent generator, each with something hidden or nothing, diagnosed unseen.

    python scripts/bench/blind.py --out blind [--cases 520] [--first-seed 20000] [--effort full] [--workers 2]
                                  [--sum-up] [--only clear subtle clean pair outside]
                                  [--hidden dead_zone hardening_spring@clamp] [--disturbance 0 0.02]
                                  [--rig servo] [--untold]

Case i has the seed first-seed + i and five to eight runs.  Clear and subtle single causes (every effect of the
catalogue at each of its places, every constant of the rig), clean rigs, pairs of clear causes and rigs with something
outside the catalogue follow one another in fixed proportions, so that the first N cases are a fair sample of all, and
a longer campaign goes on where a shorter one ended.  One file per case is kept; a case that is there already, done by
the very code of this checkout, is not done again: a campaign may be stopped and taken up.  Constants that no size
makes visible are listed, not counted.

--disturbance gives the worlds in which every case is drawn, each the share of command torque and accelerometer signal
that is disturbed besides (tests/truth/disturbance.py); 0, the default, is a perfect world. A case hides the same in all
of them, of the size that its class has in the perfect world, so that some are drowned by the disturbances; with
--sized-in-world it has that size where it stands.  Every world has its own tables, and the calibration is told over
all together, too.

--rig servo draws a geared servo that swings a pendulum in place of the flexible arm; with --untold the runs do not say
what closed their loops.

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
from station.campaign.outcome import Outcome, Task  # noqa: E402
from station.campaign.program import sources_hash  # noqa: E402
from station.campaign.run import Results, run_campaign, so_far  # noqa: E402
from station.campaign.summary import calibration, coverage, largest, median, share, summary, title  # noqa: E402
from station.estimation.cause import Key  # noqa: E402
from tests.diagnose.blind import RIGS, Cause, blind_task, judge, table  # noqa: E402
from tests.truth import RigDict, effect_names, outside_names, uncertain_keys  # noqa: E402
from tests.truth.sizes import BANDS, largest_parameter  # noqa: E402

MIX = {"clear": 128, "subtle": 128, "clean": 102, "pair": 82, "outside": 62}
"""Cases of each class in about 500: every cause three times clear and three times subtle, some of them unmade."""
CLOCK = ("clock_scale", "clock")
"""Not sized: host times, which every case with it has, always show it plainly."""
EQUIVALENT = {("input_delay", "amplifier"), ("parameter:motor.gain", "")}
"""Causes that others imitate exactly: late sensors together, the torque's scale.  The verdict must be `ambiguous`.
A clock that is off, too, without host times, which these cases have."""
WANTED: dict[str, dict[bool, tuple[float, float]]] = {
    "clear single causes named first": {True: (0.966, 1.0), False: (0.9, 1.0)},
    "subtle ones named first": {True: (0.863, 1.0), False: (0.65, 1.0)},
    "clean rigs accused": {True: (0.0, 0.02), False: (0.0, 0.05)},
    "both causes of a pair found": {True: (0.885, 1.0), False: (0.65, 1.0)},
    "outside the catalogue, wrongly `explained`": {True: (0.0, 0.05), False: (0.0, 0.05)},
    "`ambiguous` on single clear causes without a known equivalence": {True: (0.0, 0.1), False: (0.0, 0.1)},
    "truth inside the stated 95 % interval": {True: (0.88, 0.99), False: (0.85, 1.0)},
}
"""Shares wanted (lowest, highest) in a perfect world and in an imperfect one.  Those of perfect worlds that must be
high are what a former campaign reached: no share may lie below it, or above a range, by more than its interval."""
LEAST = {"clear": 200.0, "subtle": 25.0}
"""Least severity of each class."""
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


def causes(band: str, rig: RigDict) -> tuple[list[Cause], dict[str, str]]:
    """Every cause that can have a severity in the band, and why the others cannot."""
    names = effect_names(rig)
    # Without a drive motor and base are one part, and a law that may stand at either is told at the motor.
    twice = [] if rig.get("drive") else [(name, "base") for name, at in names if at == "motor"]
    found: list[Cause] = [key for key in names if (band == "clear" or key != CLOCK) and key not in twice]
    never = {} if band == "clear" else {title(CLOCK): "not sized; counted with the clear ones"}
    for key in uncertain_keys(rig):
        name = f"parameter:{key}"
        most = largest_parameter(name, rig) ** 2
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


def campaign(first_seed: int, effort: str, only: Sequence[str], chosen: Sequence[Cause],
             worlds: Sequence[float] = (0.0,), sized_in_world: bool = False, rig: str = "sflr",
             known_controller: bool = True, runs: int | None = None) -> Iterator[Task]:
    """Cases without end, each in all worlds in turn; of so many ``runs``, by default five to eight."""
    rng = np.random.default_rng([first_seed, 0xB11D])
    singles = {band: [c for c in causes(band, RIGS[rig])[0] if not chosen or c in chosen] for band in BANDS}
    plain = [c for c in causes("clear", RIGS[rig])[0] if c != CLOCK and (":" not in c[0] or c[0] in PLAIN)]
    hidden: dict[str, Iterator[list[Cause]]] = {
        **{band: ([c] for c in in_turn(singles[band], rng)) for band in BANDS},
        "clean": iter(lambda: [], None), "pair": pairs(plain, rng),
        "outside": ([(name, None)] for name in in_turn(outside_names(RIGS[rig]), rng))}
    weights = {name: MIX[name] for name in MIX if name in only and singles.get(name, True)}
    for i, name in enumerate(by_share(weights)):
        band = {"clear": "clear", "subtle": "subtle", "pair": "clear"}.get(name)
        causes_of_case = next(hidden[name])
        for level in worlds:
            yield blind_task(first_seed + i, causes_of_case, effort=effort, runs=runs, band=band, group=name,
                             disturbance=level, sized_in_world=sized_in_world and level > 0.0, rig=rig,
                             known_controller=known_controller)


def figures(outcomes: Sequence[Outcome], perfect: bool = True) -> list[dict[str, Any]]:
    """What was wanted and what was found, row by row; shares with their Wilson intervals."""
    of: dict[str, list[Outcome]] = {name: [o for o in outcomes if o.group == name] for name in MIX}
    inside = of["clear"] + of["subtle"] + of["pair"]
    alone = [o for o in of["clear"] if not o.keys & EQUIVALENT]

    def both(o: Outcome) -> bool:
        return o.keys <= set(o.said)

    def plain(o: Outcome, band: str) -> bool:
        return all(s is None or s >= LEAST[band] for s in o.severity)

    def listed(o: Outcome) -> bool:
        return o.keys <= {*o.said, *o.rivals}

    rows: list[tuple[str, dict[str, Any]]] = [
        ("clear single causes named first", share(o.named for o in of["clear"])),
        ("… named or a listed rival", share(o.listed for o in of["clear"])),
        ("… named, of those that are clear in their world", share(o.named for o in of["clear"] if plain(o, "clear"))),
        ("subtle ones named first", share(o.named for o in of["subtle"])),
        ("… named or a listed rival", share(o.listed for o in of["subtle"])),
        ("… named, of those that are subtle at least in their world",
         share(o.named for o in of["subtle"] if plain(o, "subtle"))),
        ("clean rigs accused", share(bool(o.causes) for o in of["clean"])),
        ("both causes of a pair found", share(map(both, of["pair"]))),
        ("… found or listed rivals", share(map(listed, of["pair"]))),
        ("outside the catalogue, wrongly `explained`", share(o.verdict == "explained" for o in of["outside"])),
        ("… something accused under any verdict", share(bool(o.causes) for o in of["outside"])),
        ("`ambiguous` on single clear causes without a known equivalence",
         share(o.verdict == "ambiguous" for o in alone)),
        ("`ambiguous` on single clear causes with one",
         share(o.verdict == "ambiguous" for o in of["clear"] if o.keys & EQUIVALENT)),
        ("`ambiguous`, all cases", share(o.verdict == "ambiguous" for o in outcomes)),
        ("something else accused beside a right single cause",
         share(bool(set(o.said) - o.keys) for o in of["clear"] + of["subtle"] if o.named)),
        ("truth inside the stated 95 % interval", share(held for o in inside for _, _, held in o.intervals())),
    ]
    return [{"what": what, **found, **_against(WANTED.get(what, {}).get(perfect), found, perfect)}
            for what, found in rows]


def _against(wanted: tuple[float, float] | None, found: dict[str, Any], perfect: bool) -> dict[str, Any]:
    """A share held against its bounds: what is wanted in words, and whether it is met (None: nothing to hold)."""
    if wanted is None:
        return {"wanted": "", "met": None}
    low, high = wanted
    words = f"≤ {100 * high:g} %" if low == 0.0 else f"{100 * low:g}–{100 * high:g} %"
    words = f"{100 * low:g} %" if high == 1.0 else words
    if found["share"] is None:
        return {"wanted": words, "met": None}
    least, most = (found["low"], found["high"]) if perfect and low > 0.0 else (found["share"],) * 2
    return {"wanted": words, "met": bool(most >= low and least <= high)}


def numbers(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """The figures that are no shares."""
    inside = [o for o in outcomes if o.group in ("clear", "subtle", "pair")]
    five = [o for o in outcomes if o.runs == 5]
    rows: list[tuple[str, str, Callable[[float], bool] | None, float | None, int]] = []
    for what, kind, most in (("calibration error, every cause ranked", "ranked", 0.05),
                             ("… every cause and rival stated", "stated", 0.06)):
        found = calibration(pair for o in outcomes for pair in getattr(o, kind)())
        rows.append((what, f"≤ {most}", lambda x, most=most: x <= most, found["error"], found["statements"]))
    fractions = [o.gain.get("explained_fraction") for o in inside]
    rows += [
        ("share of the explainable error removed on unseen runs, median", "0.9", lambda x: x >= 0.9, median(fractions),
         sum(f is not None for f in fractions)),
        ("seconds per diagnosis of five runs, median", "", None, median(o.seconds for o in five), len(five)),
        ("… 95th percentile", "", None, float(np.percentile([o.seconds for o in five], 95)) if five else None,
         len(five)),
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


def report(results: Results, out: Path, arguments: dict[str, Any], levels: dict[str, float], rig: RigDict) -> str:
    """Write summary.json and give the Markdown; ``levels``: the world of every case, by its label."""
    outcomes = [o for o in results.outcomes if o.unmade is None]
    whole = summary(results)
    never = {f"{band}: {name}": why for band in BANDS for name, why in causes(band, rig)[1].items()}
    parts, worlds = [], {}
    for level in sorted({levels[o.label] for o in outcomes}):
        here = [o for o in outcomes if levels[o.label] == level]
        shares, others = figures(here, level == 0.0), numbers(here)
        worlds[f"{level:g}"] = {"figures": shares, "numbers": others}
        title_of_world = "Perfect worlds" if level == 0.0 else f"Imperfect worlds, disturbed by {100 * level:g} %"
        bins = calibration(pair for o in here for pair in o.ranked())["bins"]
        parts += [f"### {title_of_world}, {len(here)} cases", markdown(shares, others, bins), by_cause(here),
                  by_parameter(here)]
    if len(worlds) > 1:
        errors = {kind: whole["calibration"][kind]["error"] for kind in ("stated", "ranked")}
        parts.append("Calibration error over all worlds: " + ", ".join(
            f"{kind} {'–' if error is None else format(error, '.3f')}" for kind, error in errors.items()) + ".")
    out.joinpath("summary.json").write_text(json.dumps(
        {"arguments": arguments, **whole, "worlds": worlds, "never": never}, indent=1), encoding="utf-8")
    unmade = {**never, **whole["unmade"]}
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
    parser.add_argument("--disturbance", nargs="+", type=float, default=[0.0], metavar="LEVEL",
                        help="draw every case in these worlds; 0 is perfect, 0.02 disturbs 2 %% of the signals")
    parser.add_argument("--sized-in-world", action="store_true",
                        help="size what is hidden in an imperfect world by how plain it is there")
    parser.add_argument("--rig", choices=list(RIGS), default="sflr")
    parser.add_argument("--runs", type=int, help="of each case; five to eight by default")
    parser.add_argument("--untold", action="store_true", help="the runs do not say what closed their loops")
    parser.add_argument("--sum-up", action="store_true", help="do nothing, sum up what is there")
    options = parser.parse_args()
    places = {title((e, at or "")): (e, at) for band in BANDS for e, at in causes(band, RIGS[options.rig])[0]}
    names = [n for text in options.hidden for n in places if text in (n, n.partition("@")[0])]
    if options.hidden and not names:
        parser.error(f"--hidden: none of {', '.join(places)}")
    worlds = list(dict.fromkeys(options.disturbance))
    endless = campaign(options.first_seed, options.effort, options.only, [places[n] for n in names], worlds,
                       options.sized_in_world, options.rig, not options.untold, options.runs)
    tasks = list(islice(endless, options.cases * len(worlds)))
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
                                        for key, value in vars(options).items()},
                 {task.label: task.spec["disturbance"] for task in tasks}, RIGS[options.rig]))
    return 1 if results.failed else 0


if __name__ == "__main__":
    sys.exit(main())
