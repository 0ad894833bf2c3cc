"""Replaying a log through its own compensator gives its commands back; other conventions do not."""

from dataclasses import replace

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.control.rounding import round_half_up
from station.errors import UsageError, WorkError
from station.runs import Run, RunMetadata, compare_replay, load_run, replay_commands
from tests.measured import measured_log
from tests.runs.examples import full_run

LIMIT = 200.0


def told(run: Run, **metadata: object) -> Run:
    return replace(run, metadata=run.metadata.model_copy(update=metadata))


@pytest.mark.parametrize("name", ["pulse", "p", "sweep"])
def test_measured_commands_of_p_control_and_open_loop_come_back_exactly(name):
    found = compare_replay(load_run(measured_log(name)), LIMIT)
    assert found.max_abs_difference == 0.0 and found.same


@pytest.mark.parametrize(("name", "shaped"), [("lead", False), ("lead", True), ("lead_accel", True)])
def test_measured_commands_of_the_lead_come_back_on_every_sample(name, shaped):
    found = compare_replay(load_run(measured_log(name)), LIMIT, shaped=shaped)
    # asked: 0.001 count.  The log prints ten digits; what is left is their rounding
    assert found.max_abs_difference < 2e-6 and found.same


def test_measured_commands_through_the_printed_accelerometer_compensator_come_back_to_0_04_count():
    run = load_run(measured_log("lead_accel"))
    found = compare_replay(run, LIMIT)
    assert 0.001 < found.max_abs_difference < 0.04
    assert "reference_shaped" in found.note


def test_the_printed_digits_are_what_limits_the_accelerometer_compensator():
    """Half a unit of the last digit of any one coefficient moves the commands by more than what is left."""
    run = load_run(measured_log("lead_accel"))
    before, left = replay_commands(run, LIMIT), compare_replay(run, LIMIT).max_abs_difference
    for key, index in (("accel_numerator", 0), ("accel_numerator", 3), ("accel_denominator", 1),
                       ("accel_denominator", 3)):
        spec = dict(run.metadata.controller)
        spec[key] = [value + 0.5e-8 * (place == index) for place, value in enumerate(spec[key])]
        moved = np.abs(replay_commands(told(run, controller=spec), LIMIT) - before).max()
        assert moved > left


@pytest.mark.parametrize(("name", "row", "least"), [
    ("p", 0, 1.5), ("p", -2, 1.5), ("sweep", 0, 0.9), ("sweep", -2, 0.9),
    ("lead", 0, 10.0), ("lead", -2, 10.0), ("lead_accel", 0, 10.0), ("lead_accel", -2, 10.0),
])
def test_no_other_command_row_gives_the_measured_commands(name, row, least):
    run = load_run(measured_log(name))
    found = compare_replay(told(run, command_row=row), LIMIT)
    assert found.max_abs_difference > least
    assert found.note == f"they fit command_row -1, the metadata say {row}"


@pytest.mark.parametrize(("recursion", "least"), [("unlimited", 20.0), ("rounded", 1.0), ("limited", 0.0)])
@pytest.mark.parametrize("name", ["lead", "lead_accel"])
def test_only_a_recursion_on_the_limited_unrounded_output_gives_the_measured_commands(name, recursion, least):
    run = load_run(measured_log(name))
    spec = {"kind": "lead", **{key: run.metadata.controller[key] for key in ("gain", "zero", "pole")}}
    lead = Compensator.from_spec(spec, 500.0, LIMIT)
    (b0, b1), a1 = lead.numerator, lead.denominator[1]
    worst = error = kept = 0.0
    for target, encoder, logged in zip(run.extra["reference_shaped"][1:], run.encoder, run.command[1:], strict=False):
        raw = b0 * (target - encoder) + b1 * error - a1 * kept
        limited = min(max(raw, -LIMIT), LIMIT)
        error = target - encoder
        kept = {"unlimited": raw, "rounded": float(round_half_up(limited)), "limited": limited}[recursion]
        worst = max(worst, abs(limited - logged))
    assert worst > least if least else worst < 2e-6


def closed_loop(command_row: int, rounding: bool, rows: int = 400) -> Run:
    """A made-up log whose commands come from a compensator stepped by hand."""
    spec = {"kind": "lead_accel", "gain": 3.0, "zero": 10.0, "pole": 90.0,
            "accel_numerator": [0.1, -0.05], "accel_denominator": [1.0, -0.9]}
    rng = np.random.default_rng(5)
    encoder, accel = np.round(np.cumsum(rng.normal(size=rows))), np.round(rng.normal(size=rows, scale=9)) + 3.0
    reference = np.where(np.arange(rows) < 50, 0.0, 60.0)
    compensator = Compensator.from_spec(spec, 500.0, LIMIT)
    compensator.reset(3.0)
    command = np.zeros(rows)
    for row in range(-command_row, rows):
        source = row + command_row
        command[row] = compensator.step(reference[row], encoder[source], accel[source])
        if rounding:
            command[row] = round_half_up(command[row])
    metadata = RunMetadata(controller=spec, command_row=command_row, rounding=rounding, accel_zero=3.0,
                           rig={"amplifier": {"limit": LIMIT}})
    return Run(name="made", t=np.arange(rows) / 500.0, reference=reference, command=command, encoder=encoder,
               accel=accel, metadata=metadata)


@pytest.mark.parametrize("command_row", [0, -1, -4])
@pytest.mark.parametrize("rounding", [True, False])
def test_a_made_log_comes_back_exactly_whatever_its_delay_and_rounding(command_row, rounding):
    run = closed_loop(command_row, rounding)
    found = compare_replay(run)
    assert found.max_abs_difference == 0.0 and found.same and found.note == "every command is the compensator's"


def test_a_changed_command_is_found_at_its_row():
    run = closed_loop(-1, True)
    command = run.command.copy()
    command[123] += 1.0
    found = compare_replay(replace(run, command=command))
    assert (found.first_row, found.rows_beyond, found.row, found.max_abs_difference) == (123, 1, 123, 1.0)
    assert found.note == "from row 123 on they are not this compensator's"


def test_the_cause_of_a_difference_is_named():
    run = closed_loop(-1, True)
    assert "rounded, the metadata say it was not" in compare_replay(told(run, rounding=False)).note
    assert "command_row -1" in compare_replay(told(run, command_row=0)).note
    command, status = run.command.copy(), np.zeros(len(run))
    command[200:203] += 2.0
    status[200:203] = 4
    assert "another status" in compare_replay(replace(run, command=command, status=status)).note


def test_what_a_replay_needs_is_asked_for():
    run = closed_loop(-1, True)
    with pytest.raises(UsageError, match=r"amplifier\.limit"):
        replay_commands(told(run, rig="sflr"))
    with pytest.raises(WorkError, match="the run has none"):
        replay_commands(replace(run, accel=None))
    with pytest.raises(WorkError, match="no column reference_shaped"):
        replay_commands(run, shaped=True)
    with pytest.raises(WorkError, match="made: the log names no controller"):
        compare_replay(told(run, controller={"kind": "unknown"}))
    n = np.arange(len(run))
    n[100:] += 1
    with pytest.raises(WorkError, match="1 samples lost"):
        replay_commands(replace(run, n=n, t=n / 500.0))


def test_an_open_loop_run_is_its_reference():
    run = full_run()
    run = told(replace(run, command=run.reference), controller={"kind": "open"})
    assert compare_replay(run, LIMIT).same
