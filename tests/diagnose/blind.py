"""One blind case: a rig with a hidden cause, tested, diagnosed, and then held against what was hidden.

The code under test is given the case's runs and the nominal rig, nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence

from station.campaign.outcome import Outcome, Task, diagnosed
from station.campaign.summary import title
from tests.truth import OUTSIDE, RIGID_AXIS, SERVO, SFLR, TWO_MASS, Case, make_case

BAND = (400.0, 1e5)
"""Severity that a hidden effect is sized for unless a task says otherwise: from twice what the contract calls clear to
what nobody overlooks.  `clock_scale` and causes outside the catalogue are not sized, only drawn; a constant, which
costs its own uncertainty, can seldom be as plain: from what the contract calls clear on."""
RUNS = 5

RIGS = {"sflr": SFLR, "servo": SERVO, "axis": RIGID_AXIS, "two-mass": TWO_MASS}
"""Rigs that cases are drawn around: the flexible arm, a geared servo that swings a pendulum, one inertia on a motor,
and two joined by a shaft."""

Cause = tuple[str, str | None]
"""(effect, at); at None where the effect has one place, or any will do."""


def blind_task(seed: int, hidden: Sequence[Cause] = (), *, effort: str = "full", runs: int | None = RUNS,
               band: str | None = None, group: str = "", disturbance: float = 0.0,
               sized_in_world: bool = False, rig: str = "sflr", known_controller: bool = True) -> Task:
    """One case to be made and diagnosed; with nothing hidden a clean rig.

    `runs` None: five to eight; `band`: "clear" or "subtle", else BAND; `disturbance`: level of an imperfect world
    (tests/truth/disturbance.py), 0 for a perfect one; `sized_in_world`: the band holds there, not in the perfect world;
    `rig`: one of RIGS; `known_controller`: whether the runs say what closed their loops.
    """
    name = "+".join(title((effect, at or "")) for effect, at in hidden) or "clean"
    world = f"{'sized' if sized_in_world else 'disturbed'}{disturbance:g}" if disturbance else ""
    told = "" if rig == "sflr" else rig
    loops = "" if known_controller else "untold"
    label = "-".join(part for part in (f"{seed:06d}", told, loops, world, band, name, effort) if part)
    outside = any(effect in OUTSIDE for effect, _ in hidden)
    kind = "clean" if not hidden else "outside" if outside else "single" if len(hidden) == 1 else "pair"
    return Task(label, group or kind, {"seed": seed, "hidden": [list(cause) for cause in hidden], "effort": effort,
                                       "runs": runs, "band": band, "disturbance": disturbance,
                                       "sized_in_world": sized_in_world, "rig": rig,
                                       "known_controller": known_controller})


def made(task: Task) -> Case:
    """The case of a task; ValueError where none of the rigs drawn shows the cause at any size."""
    hidden = [(effect, at) if at else effect for effect, at in task.spec["hidden"]]
    band = task.spec["band"]
    if band is None:
        band = "clear" if any(effect.startswith("parameter:") for effect, _ in task.spec["hidden"]) else BAND
    return make_case(task.spec["seed"], hidden, count=task.spec["runs"], band=band,
                     nominal=RIGS[task.spec["rig"]], disturbance=task.spec["disturbance"],
                     sized_in_world=task.spec["sized_in_world"], known_controller=task.spec["known_controller"])


def judge(task: Task) -> Outcome:
    """Make a case, diagnose it blind, open the seal."""
    from station.rig import Rig, load_rig

    begun = time.perf_counter()
    try:
        case = made(task)
    except ValueError as error:
        return Outcome(task.label, task.group, unmade=str(error), making=time.perf_counter() - begun)
    making = time.perf_counter() - begun
    name = task.spec["rig"]
    nominal = load_rig(name) if name == "sflr" else Rig.model_validate(RIGS[name])
    return diagnosed(task, nominal, case.runs, task.spec["effort"], hidden=case.truth["causes"],
                     outside=bool(case.truth["outside"]),
                     severity=list(case.truth.get("severity_in_world", case.truth["severity"]).values()),
                     making=making)


def table(outcomes: Iterable[Outcome]) -> str:
    """One line per case."""
    lines = [f"{'case':52s} {'severity':>8s}  {'verdict':16s} {'ok':3s} "
             f"{'encoder nrmse':>15s} {'accel nrmse':>15s} {'made s':>6s} {'s':>5s} {'CPU s':>5s}  named"]
    for o in outcomes:
        if o.unmade is not None:
            lines.append(f"{o.label:52s} not made: {o.unmade}")
            continue
        right = not o.causes if o.clean else o.verdict != "explained" if o.outside else o.named and o.better
        errors = {channel: f"{before:.3f} > {after:.3f}" for channel, before, after in o.errors}
        severity = min((s for s in o.severity if s is not None), default=0.0)
        named = ", ".join(f"{title(key)} {c['probability']:.2f}" for key, c in zip(o.said, o.causes, strict=True))
        lines.append(f"{o.label:52s} {severity:8.0f}  {o.verdict:16s} {'yes' if right else 'NO':3s} "
                     f"{errors.get('encoder', ''):>15s} {errors.get('accel', ''):>15s} {o.making:6.1f} "
                     f"{o.seconds:5.1f} {o.cpu:5.1f}  {named or '-'}")
    return "\n".join(lines)
