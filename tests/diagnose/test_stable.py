"""What is said of a rig does not hang on what says nothing of it: order, threads, ends, zero, files and rows.

On one made case, and on the measured logs of both rigs where they are there.  Quick effort: the full one takes the same
steps, more of them.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from threadpoolctl import threadpool_limits

from station.diagnose.diagnose import diagnose
from station.diagnose.result import Cause, Diagnosis, Estimate
from station.diagnose.thresholds import OUTSIDE
from station.estimation import pool as module
from station.rig import Rig, load_rig
from station.runs import load_run
from station.runs.run import Run
from tests.measured import LOGS, SERVO_LOGS, measured_folder, measured_log
from tests.truth import RIGID_AXIS, make_case

CLOSE = 0.05
"""Largest change of a probability."""
CUT = 0.02
"""Share of each run's end."""
COUNTS = 200_000.0
"""Of the command per unit: an amplifier's limit is then some thousandths."""
SEED = 11
Given = tuple[Rig, tuple[Run, ...]]


def made() -> Given:
    return Rig.model_validate(RIGID_AXIS), tuple(
        make_case(8001, [("coulomb_friction", "motor")], nominal=RIGID_AXIS, count=4, band=(400.0, 1e5)).runs)


def arm() -> Given:
    return load_rig("sflr"), tuple(load_run(measured_log(name)) for name in LOGS)


def servo() -> Given:
    paths = [measured_log(name, "xl330") for name in SERVO_LOGS]
    return load_rig(str(measured_folder("xl330") / "rig.toml")), tuple(load_run(path) for path in paths)


def rows(run: Run, kept: slice, name: str | None = None) -> Run:
    """Some rows of a run, which none lacks, beginning at time 0."""
    columns = {key: value[kept] for key, value in run.columns().items() if key not in run.extra and key != "n"}
    columns["t"] = columns["t"] - columns["t"][0]
    return replace(run, **columns, n=None, extra={}, name=name or run.name)


def reversed_order(rig: Rig, runs: tuple[Run, ...]) -> Given:
    return rig, runs[::-1]


def cut(rig: Rig, runs: tuple[Run, ...]) -> Given:
    """Every run's end cut off."""
    return rig, tuple(rows(run, slice(0, len(run) - round(CUT * len(run)))) for run in runs)


def shuffled_and_moved(rig: Rig, runs: tuple[Run, ...]) -> Given:
    """In another order, the zero moved by a count; the reference of a closed loop with it."""
    moved = [replace(run, encoder=run.encoder + 1.0, reference=run.reference + (0.0 if run.open_loop else 1.0))
             for run in runs]
    random.Random(SEED).shuffle(moved)
    return rig, tuple(moved)


def split(rig: Rig, runs: tuple[Run, ...]) -> Given:
    """The longest run, in two."""
    longest = max(runs, key=len)
    half = len(longest) // 2
    halves = (rows(longest, slice(0, half), f"{longest.name} 1"), rows(longest, slice(half, None), f"{longest.name} 2"))
    return rig, (*(run for run in runs if run is not longest), *halves)


def half_rate(rig: Rig, runs: tuple[Run, ...]) -> Given:
    """Logs of every other tick of the same rig."""
    return rig, tuple(rows(run, slice(None, None, 2)) for run in runs)


def untold(rig: Rig, runs: tuple[Run, ...]) -> Given:
    """Without what closed the loops."""
    return rig, tuple(run if run.open_loop else
                      replace(run, metadata=run.metadata.model_copy(update={"controller": {"kind": "unknown"}}))
                      for run in runs)


def in_large_units(rig: Rig, runs: tuple[Run, ...]) -> Given:
    """The same motor, its commands in another unit (of loops whose controller is not told)."""
    limits = rig.limits and rig.limits.model_copy(update={"command": rig.command_limit / COUNTS})
    rig = rig.with_constants({"motor.gain": rig.motor.gain * COUNTS}).model_copy(update={
        "amplifier": rig.amplifier.model_copy(update={"limit": rig.amplifier.limit / COUNTS}), "limits": limits})
    return rig, tuple(replace(run, command=run.command / COUNTS,
                              reference=run.reference / COUNTS if run.open_loop else run.reference,
                              metadata=run.metadata.model_copy(update={"command_limit": None})) for run in runs)


DATA: dict[str, Callable[[], Given]] = {"made": made, "servo": servo, "arm": arm}
TOGETHER = "order, zero, end, controller, unit and file, one thread"
CHANGES: dict[str, tuple[int, tuple[Callable[..., Given], ...]]] = {
    TOGETHER: (1, (shuffled_and_moved, cut, untold, in_large_units, split)),
    "half rate": (2, (half_rate,))}
"""By so many threads; what is changed together is held to the criterion of each alone."""
HELD = [pytest.param(data, change, marks=pytest.mark.long if data != "made" else ())
        for data in DATA for change in CHANGES]
"""What holds to that criterion."""


@cache
def given(data: str) -> Given:
    return DATA[data]()


@cache
def plain(data: str) -> Diagnosis:
    """What is said of the runs as they are, by two threads."""
    return said(*given(data))


@cache
def changed(data: str, change: str) -> Diagnosis:
    (threads, steps), (rig, runs) = CHANGES[change], given(data)
    for step in steps:
        rig, runs = step(rig, runs)
    return said(rig, runs, threads)


def said(rig: Rig, runs: Sequence[Run], threads: int = 2) -> Diagnosis:
    return diagnose(rig, runs, effort="quick", threads=threads).diagnosis


def keyed(found: Diagnosis) -> dict[tuple[str, str], Cause]:
    return {(cause.effect, cause.at): cause for cause in found.causes}


def within(one: Estimate, other: Estimate) -> bool:
    """Within half their interval."""
    return abs(one.value - other.value) <= 0.25 * (one.high - one.low + other.high - other.low)


def differences(one: Diagnosis, other: Diagnosis) -> list[str]:
    """What two diagnoses say differently."""
    found = []
    if one.verdict != other.verdict:
        found.append(f"verdict {one.verdict}, {other.verdict}")
    before, after = keyed(one), keyed(other)
    if before.keys() != after.keys():
        found.append(f"causes {sorted(before)}, {sorted(after)}")
    for key in before.keys() & after.keys():
        if abs(before[key].probability - after[key].probability) > CLOSE:
            found.append(f"{key} {before[key].probability:.3f}, {after[key].probability:.3f}")
        found += [f"{key} {name} {value.value:.4g} ({value.low:.4g} to {value.high:.4g}), "
                  f"{after[key].parameters[name].value:.4g}"
                  for name, value in before[key].parameters.items() if not within(value, after[key].parameters[name])]
    return found


@pytest.mark.parametrize(("data", "change"), HELD)
def test_the_same_is_said_however_the_runs_are_given(data: str, change: str) -> None:
    assert differences(plain(data), changed(data, change)) == []


@pytest.mark.parametrize(("threads", "algebra"), [(1, 1), (4, None)])
def test_other_threads_say_to_the_last_digit_what_two_say_of_the_same_runs_in_reversed_order(
        threads: int, algebra: int | None) -> None:
    """Whether linear algebra is limited to one thread outside, or has all that there are."""
    with threadpool_limits(algebra or os.cpu_count()):
        alone = said(*reversed_order(*given("made")), threads=threads)
    assert by_run(alone) == by_run(plain("made"))


def test_every_part_of_a_diagnosis_can_be_sent_to_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes back unanswered is done again here, and nobody would see it but by the clock."""
    answers: list[Any] = []
    plain_ask, plain_sent = module._Helper.ask, module._sent

    def ask(helper: module._Helper, function: bytes | None, part: object) -> object:
        answers.append(plain_ask(helper, function, part))
        return answers[-1]

    def sent(what: object) -> bytes | None:
        answers.append(plain_sent(what))
        return answers[-1]

    module.Pool(2)
    end = time.monotonic() + 60.0
    while not any(helper.ready for helper in module._beside.helpers):
        assert time.monotonic() < end
        time.sleep(0.05)
    monkeypatch.setattr(module._Helper, "ask", ask)
    monkeypatch.setattr(module, "_sent", sent)
    said(*given("made"), threads=2)
    assert len(answers) > 20 and None not in answers


def by_run(found: Diagnosis) -> Diagnosis:
    """The same with its runs by name."""
    gain, between = found.gain, found.between_runs
    assert between is not None
    return found.model_copy(update={
        "runs": sorted(found.runs, key=lambda row: row.run),
        "gain": gain.model_copy(update={"held_out": sorted(gain.held_out),
                                        "runs": sorted(gain.runs, key=lambda row: row.run)}),
        "between_runs": between.model_copy(update={"runs": sorted(between.runs, key=lambda row: row.run)})})


def laws(found: Diagnosis) -> dict[str, Cause]:
    """With a drive that hardly yields friction at the motor is friction at the base: which of the two may change."""
    return {cause.effect: cause for cause in found.causes}


@pytest.mark.long
def test_every_other_row_of_the_arm_names_the_same_laws() -> None:
    """Half the rows hold half the evidence, and yet each cause keeps at least 0.8 of what the catalogue has."""
    whole, other = plain("arm"), changed("arm", "half rate")
    assert whole.verdict == other.verdict and laws(whole).keys() == laws(other).keys()
    assert min(cause.probability for cause in other.causes) > 0.8 * (1.0 - OUTSIDE)
    assert overlapping(laws(whole), laws(other))


def overlapping(one: dict[str, Cause], other: dict[str, Cause]) -> bool:
    """Whether the intervals of what both name overlap."""
    pairs = [(value, other[name].parameters[key]) for name in one.keys() & other.keys()
             for key, value in one[name].parameters.items()]
    return bool(pairs) and all(a.low < b.high and b.low < a.high for a, b in pairs)


@pytest.mark.long
@pytest.mark.parametrize("data", ["servo", "arm"])
def test_of_a_measured_rig_no_cause_is_surer_than_that_the_catalogue_holds_what_acts(data: str) -> None:
    found = plain(data)
    assert found.verdict == "partly_explained"
    assert 0.8 < found.causes[0].probability < 1.0 - OUTSIDE + 1e-9
    assert all(row.probability < 1.0 - OUTSIDE + 1e-9 for row in found.ranking)


def test_the_made_case_is_one_in_which_something_is_said() -> None:
    assert ("coulomb_friction", "motor") in keyed(plain("made"))


@pytest.mark.long
def test_a_servos_gears_lose_torque_with_their_load_whether_or_not_its_controller_is_known() -> None:
    for found in (plain("servo"), changed("servo", TOGETHER)):
        cause, *_ = found.causes
        assert cause.effect == "load_friction" and cause.probability > 0.8 and cause.stability > 0.8


@pytest.mark.parametrize(("change", "names"), [({"verdict": "ambiguous"}, "verdict"), ({"causes": []}, "causes")])
def test_differences_are_seen(change: dict, names: str) -> None:
    estimate = Estimate(value=1.0, low=0.8, high=1.2, unit="N m")
    cause = Cause(effect="coulomb_friction", at="motor", probability=0.9, parameters={"torque": estimate})
    one = Diagnosis.model_validate({"verdict": "explained", "causes": [cause], "gain": {"held_out": []}})
    assert differences(one, one) == []
    assert names in differences(one, one.model_copy(update=change))[0]
    less = cause.model_copy(update={"probability": 0.84})
    more = cause.model_copy(update={"parameters": {"torque": estimate.model_copy(update={"value": 1.21})}})
    for other in (less, more):
        assert len(differences(one, one.model_copy(update={"causes": [other]}))) == 1
