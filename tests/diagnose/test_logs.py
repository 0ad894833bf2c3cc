"""Logs that are not what they say: another controller, or more than the amplifier gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.diagnose.diagnose import diagnose
from station.diagnose.logs import as_logged, off_by
from station.diagnose.thresholds import OWN_COMMANDS
from station.estimation.dataset import dataset
from station.estimation.observer import observers
from station.estimation.prediction import predict_run
from station.model.effects import Effect, effect_class
from station.model.simulate import build, simulate
from station.rig import load_rig
from station.runs import load_run
from station.runs.replay import compare_replay
from station.runs.run import Run
from tests.estimation.made import AXIS, run_of, runs_of
from tests.measured import LOGS, SERVO_LOGS, measured_folder, measured_log

RUNS = runs_of(AXIS)
CLOSED = [run for run in RUNS if not run.open_loop]


def of(run, **spec):
    """The run, its log naming another controller."""
    return replace(run, metadata=run.metadata.model_copy(update={"controller": run.metadata.controller | spec}))


def test_a_log_whose_commands_are_its_controllers_stays_as_it_is() -> None:
    found, said = as_logged(AXIS, RUNS)
    assert all(one is run for one, run in zip(found, RUNS, strict=True)) and said == []
    assert all(off_by(AXIS, run) < 0.01 for run in RUNS)


def test_commands_of_another_controller_make_it_unknown() -> None:
    found, said = as_logged(AXIS, [of(run, gain=20.0) for run in CLOSED])
    assert [run.metadata.controller for run in found] == [{"kind": "unknown"}] * 2
    (sentence,) = said
    assert "and 1 more" in sentence and "station replay" in sentence


@pytest.mark.parametrize("true", [0, -2])
def test_the_row_whose_readings_commands_are_of_is_taken_as_they_have_it(true: int) -> None:
    """Most logs of other programs do not say it, and a loop that is closed a tick too late is another loop."""
    def of_row(run: Run, row: int) -> Run:
        return replace(run, metadata=run.metadata.model_copy(update={"command_row": row}))
    runs = [of_row(run, true) for run in CLOSED]
    made = [simulate(AXIS, run) for run in runs]
    runs = [replace(run, command=one.command, encoder=np.round(one.encoder))
            for run, one in zip(runs, made, strict=True)]
    assert [run.metadata.command_row for run in as_logged(AXIS, runs)[0]] == [true, true]
    found, (sentence,) = as_logged(AXIS, [of_row(run, -1) for run in runs])
    assert [run.metadata.command_row for run in found] == [true, true]
    assert f"and 1 more: commands are the controller's of command_row {true}" in sentence
    assert as_logged(AXIS, runs) == (runs, [])


@pytest.mark.parametrize("late", [1, 2])
def test_the_row_whose_reference_commands_are_of_is_taken_as_they_have_it(late: int) -> None:
    """A board that works out a command from what it has read and been told a tick ago logs both a tick early."""
    acted = [replace(run, reference=np.where(np.arange(len(run)) < 200, 0.0, run.reference),
                     metadata=run.metadata.model_copy(update={"command_row": -late})) for run in CLOSED]
    made = [simulate(AXIS, run) for run in acted]
    acted = [replace(run, command=one.command, encoder=np.round(one.encoder))
             for run, one in zip(acted, made, strict=True)]
    logged = [replace(run, reference=np.append(run.reference[late:], run.reference[-1:].repeat(late)))
              for run in acted]
    found, (sentence,) = as_logged(AXIS, logged)
    assert all(np.array_equal(one.reference, run.reference) for one, run in zip(found, acted, strict=True))
    assert [one.metadata for one in found] == [run.metadata for run in acted]
    rows = f"{late} row{'s' if late > 1 else ''}"
    told = f"command_row {-late}, of a reference that acts {rows} after its own"
    assert told in sentence
    assert compare_replay(logged[0], AXIS.amplifier.limit).note == f"they fit {told}, the metadata say {-late}"
    assert as_logged(AXIS, acted) == (acted, [])


def test_an_integral_that_began_from_commands_before_they_were_rounded_is_its_own() -> None:
    """Half a count of the first commands stays in an integral for good, many times as large by the derivative's lag."""
    spec = {"kind": "pid", "gain": 0.4, "integral": 0.5, "derivative": 0.25, "filter": 0.05}
    for run in CLOSED:
        run = replace(run, reference=run.reference - 9.7, metadata=run.metadata.model_copy(update={"controller": spec}))
        made = simulate(AXIS, run)
        run = replace(run, command=made.command, encoder=np.round(made.encoder))
        assert as_logged(AXIS, [run]) == ([run], [])
        counts = np.sqrt(np.mean(np.square(run.command)))
        assert off_by(AXIS, run) * counts < 0.5 and counts > 5.0
        assert as_logged(AXIS, [of(run, gain=0.8)])[1]


def in_volts(run: Run, per_volt: float = 20.0) -> Run:
    """The run of a lab whose commands are volts, with three decimals, by a loop whose gain is in volts per count."""
    run = of(run, gain=run.metadata.controller["gain"] / per_volt)
    made = simulate(VOLTS, replace(run, command=run.command + 0.5))     # a log of halves is of no whole numbers
    return replace(run, command=np.round(made.command, 3), encoder=made.encoder)


VOLTS = AXIS.with_constants({"amplifier.limit": AXIS.amplifier.limit / 20.0, "motor.gain": 20.0 * AXIS.motor.gain})


@pytest.mark.parametrize("stated", [{}, {"rounding": False}])
def test_commands_that_are_no_whole_counts_are_their_controllers_and_are_simulated_so(stated: dict[str, bool]) -> None:
    """Rounded to whole volts they were another controller's, and the closed loop another loop."""
    runs = [of(in_volts(run), **stated) for run in CLOSED]
    assert not any(run.rounded for run in runs) and as_logged(VOLTS, runs) == (runs, [])
    for run in runs:
        again = simulate(VOLTS, run)
        assert np.ptp(run.command) > 1.0 and np.abs(again.command - run.command).max() < 0.06
        assert np.abs(again.encoder - run.encoder).max() <= 1.0


def test_a_controller_that_is_none_is_left_to_who_simulates_it() -> None:
    odd = of(CLOSED[0], kind="none that there is")
    assert off_by(AXIS, odd) == 0.0 and as_logged(AXIS, [odd])[0] == [odd]


def gapped(run: Run, first: int, end: int) -> Run:
    """The run without some rows."""
    kept = np.delete(np.arange(len(run)), np.arange(first, end))
    return Run.from_columns(run.name, run.name, {name: values[kept] for name, values in run.columns().items()}
                            | {"n": kept}, run.metadata).filled()


@pytest.mark.parametrize("kind", ["p2", "lead", "pid"])
def test_a_log_that_begins_in_motion_or_has_a_gap_is_of_its_controller_still(kind: str) -> None:
    rig = load_rig("sflr")
    run = run_of(rig, 80.0, kind, kind, 2.0)
    logs = [run, run.slice(60), gapped(run, 60, 110)]
    assert np.max(np.abs(run.command[60:110])) > 10.0
    assert max(off_by(rig, one) for one in logs) < 0.5 * OWN_COMMANDS      # a count, rounded, that an integral keeps
    other = 1.5 * run.metadata.controller["gain"]
    assert min(off_by(rig, of(one, gain=other)) for one in logs) > OWN_COMMANDS


def test_commands_beyond_the_amplifiers_limit_are_told() -> None:
    limit = 0.5 * float(np.max(np.abs(RUNS[-1].command)))
    small = AXIS.model_copy(update={"amplifier": AXIS.amplifier.model_copy(update={"limit": limit})})
    _, said = as_logged(small, RUNS[-1:])
    assert len(said) == 1 and "amplifier.limit" in said[0] and RUNS[-1].name in said[0]


@pytest.mark.parametrize("effects", [[], [effect_class("dead_zone")(at="amplifier", width=2.0)]])
def test_commands_beyond_the_amplifiers_limit_are_cut_in_simulations_and_predictions(effects: list[Effect]) -> None:
    run, limit = RUNS[-1], 0.5 * float(np.max(np.abs(RUNS[-1].command)))
    amplifier = AXIS.amplifier.model_copy(update={"limit": limit})
    small = AXIS.model_copy(update={"amplifier": amplifier}).with_effects(effects)
    cut = replace(run, command=np.clip(run.command, -limit, limit))
    assert np.array_equal(simulate(small, run).encoder, simulate(small, cut).encoder)
    made = [predict_run(data, build(data.rig), observers(data.rig, 0.0, (0.05,)), 0, data.own[0])[0]
            for data in (dataset(small, [one]) for one in (run, cut))]
    assert np.array_equal(*made) and np.ptp(made[0][0, 0]) > 1.0


def test_a_command_that_is_rounded_beyond_the_limit_is_not_told() -> None:
    rig = AXIS.model_copy(update={"amplifier": AXIS.amplifier.model_copy(update={"limit": 59.6})})
    assert float(np.max(np.abs(RUNS[-1].command))) == 60.0 and as_logged(rig, RUNS[-1:])[1] == []


def test_the_gain_is_told_a_time_ahead_where_the_logs_name_another_controller() -> None:
    result = diagnose(AXIS, [of(run, gain=20.0) for run in CLOSED] + RUNS[-1:], effort="quick")
    assert len(result.amiss) == 1 and result.amiss[0].startswith(tuple(run.name for run in CLOSED))
    assert [row.seconds_ahead is None for row in result.comparisons] == [run.name == "pulses" for run in
                                                                        sorted(RUNS, key=lambda run: run.name)]


@pytest.mark.parametrize("folder", ["sflr", "xl330"])
def test_the_measured_logs_name_their_controllers(folder: str) -> None:
    rig = load_rig("sflr" if folder == "sflr" else str(measured_folder(folder) / "rig.toml"))
    logs = LOGS if folder == "sflr" else SERVO_LOGS
    shares = [off_by(rig, load_run(measured_log(name, folder)).filled(rig.sample_rate)) for name in logs]
    assert max(shares) < 0.05 * OWN_COMMANDS
