"""A test through the real loop: rows, conventions, metadata."""

import contextlib
import gc
import sys
import threading
import time

import numpy as np
import pytest

from station.control.references import reference_from_test
from station.device.client import Client
from station.device.port import open_port
from station.device.protocol import State, Status
from station.errors import UsageError, WorkError
from station.model.effects.command_bias import CommandBias
from station.model.simulate import simulate
from station.runs.columns import LOG_COLUMNS
from station.runs.replay import compare_replay
from station.runs.run import RunMetadata

LEAD_ACCEL = {"kind": "lead_accel", "gain": 20.0, "zero": 31.4159, "pole": 125.6637,
              "accel_numerator": [0.00045097, 0.00045152, -0.00044989, -0.00045043],
              "accel_denominator": [1.0, -2.9289362, 2.85853684, -0.92960052]}


@pytest.mark.parametrize("spec", [{"kind": "open"}, {"kind": "p", "gain": 2.0}, None, LEAD_ACCEL])
def test_replaying_the_log_gives_its_commands_back_exactly(rows, spec):
    result = rows.test_at("sim://sflr?seed=1&noise=1.5", spec, reference=rows.reference(amplitude=80.0))
    replay = compare_replay(rows.run, tolerance=0.0)
    assert replay.same, replay.note
    assert result.counts.unanswered == result.counts.lost == 0
    assert rows.run.command_row == -1


def test_the_device_and_the_simulation_are_the_same_rig(rows):
    rows.test_at("sim://sflr")
    run = rows.run
    made = simulate(rows.rig, run)
    assert np.array_equal(made.encoder, run.encoder)
    assert np.array_equal(made.accel, run.accel)
    assert np.array_equal(made.command, run.command)
    assert np.max(run.encoder) > 50


@pytest.mark.parametrize("answer_ticks", [1, 2, 4])
def test_a_command_is_of_its_own_reference_and_the_readings_answer_ticks_before(rows, answer_ticks):
    rows.test_at("sim://sflr", {"kind": "p", "gain": 1.0}, answer_ticks=answer_ticks)
    run = rows.run
    assert np.array_equal(run.command[:answer_ticks], np.zeros(answer_ticks))
    assert np.array_equal(run.command[answer_ticks:], run.reference[answer_ticks:] - run.encoder[:-answer_ticks])
    assert np.array_equal(run.command_sent[:-answer_ticks], run.command[answer_ticks:])
    assert run.command_row == -answer_ticks
    assert compare_replay(run, tolerance=0.0).same


def test_in_open_loop_the_command_is_the_reference(rows):
    rows.test_at("sim://sflr", {"kind": "open"}, reference=rows.reference(amplitude=37.5))
    assert set(rows.run.command.tolist()) == {0.0, 38.0}  # a half goes up
    assert np.array_equal(np.floor(rows.run.reference + 0.5), rows.run.command)


def test_the_rows_have_the_logs_columns_and_clocks(rows):
    rows.test_at("sim://sflr")
    run = rows.run
    assert len(rows.sinks[-1].rows[0]) == len(LOG_COLUMNS)
    assert np.array_equal(run.n, np.arange(600))
    assert np.array_equal(run.t, np.arange(600) / 500.0)
    assert np.allclose(run.device_time, run.t, atol=1e-9, rtol=0.0)
    assert np.all(np.diff(run.host_time) >= 0.0)
    assert np.all(run.latency > 0.0)
    assert np.allclose(run.slack, 0.002 - run.latency)
    assert np.all((run.status & (Status.RUNNING | Status.FAULT)) == Status.RUNNING)


def test_saturation_shows_in_the_status_of_a_tighter_device_only(rows):
    rows.test_at("sim://sflr", reference=rows.reference(amplitude=200.0))
    assert np.max(np.abs(rows.run.command)) == 200.0  # the compensator's own limit
    assert not np.any(rows.run.status & Status.SATURATED)


def test_the_log_is_made_from_complete_metadata_and_closed_with_the_counts(rows):
    result = rows.test_at("sim://sflr", metadata={"test": {"kind": "step", "amplitude": 100}, "note": "kept"})
    metadata = rows.sinks[-1].metadata
    assert rows.sinks[-1].closed
    assert metadata == result.metadata
    assert metadata.rig["name"] == "sflr"
    assert metadata.controller["kind"] == "lead"
    assert metadata.test == {"kind": "step", "amplitude": 100}
    assert metadata.firmware["board"] == "sflr"
    assert 0 < metadata.session < 65536
    assert metadata.command_row == -1
    assert metadata.zero_id == result.identity.zero_id
    extra = metadata.model_extra
    assert extra["note"] == "kept"
    assert extra["clock"] == "virtual"
    assert extra["counts"]["samples"] == 600
    assert RunMetadata.from_json("run", metadata.to_json()) == metadata


def test_the_accelerometers_zero_is_measured_at_rest_and_taken_off(rows):
    result = rows.test_at("sim://sflr?accel_offset=31&noise=1&seed=3", LEAD_ACCEL, accel_zero=None)
    assert result.rest.accel_zero == pytest.approx(31.0, abs=0.4)
    assert result.rest.accel_sigma == pytest.approx(1.0, rel=0.3)
    assert rows.run.metadata.accel_zero == result.rest.accel_zero
    assert compare_replay(rows.run, tolerance=0.0).same
    still = int(np.argmax(rows.run.encoder != rows.run.encoder[0]))
    assert still > 50
    assert np.max(np.abs(rows.run.command[:still])) <= 2.0  # without it the offset would drive the arm from the start


def test_a_relative_reference_begins_where_the_encoder_rests(rows):
    result = rows.test_at("sim://sflr?angle=0.5", relative=True)
    assert result.rest.encoder == 81
    assert rows.run.reference[0] == 81.0
    assert rows.run.reference[-1] == 181.0
    assert not np.any(rows.run.command[:100])
    rows.test_at("sim://sflr?angle=0.5", {"kind": "open"}, relative=True, reference=rows.reference(amplitude=10.0))
    assert rows.run.reference[0] == 0.0


def test_runs_of_one_device_share_its_encoder_zero_and_no_session(rows):
    with open_port("sim://sflr") as port:
        results = [rows.test(port, relative=True) for _ in range(3)]
    assert len({result.metadata.zero_id for result in results}) == 1
    assert len({result.metadata.session for result in results}) == 3
    assert rows.sinks[1].rows[0][4] == pytest.approx(100, abs=40)  # the second begins where the first left the arm


def test_progress_is_told_from_beside_the_loop(rows, monkeypatch):
    monkeypatch.setattr("station.loop.display.PERIOD", 1e-4)
    told = []
    rows.test_at("sim://sflr", rows=3000, progress=lambda row, total: told.append((row, total, threading.get_ident())))
    assert len(told) > 5
    assert all(total == 3000 and thread != threading.get_ident() for _, total, thread in told)
    seen = [row for row, *_ in told]
    assert seen == sorted(seen) and seen[-1] < 3000 and len(set(seen)) > 3


@pytest.mark.parametrize("display", [lambda: 1 / 0, lambda: time.sleep(30.0)], ids=["fails", "hangs"])
def test_a_display_that_fails_or_hangs_changes_nothing(rows, monkeypatch, display):
    monkeypatch.setattr("station.loop.display.PERIOD", 1e-4)
    monkeypatch.setattr("station.loop.display._PATIENCE", 0.05)
    begun = time.monotonic()
    result = rows.test_at("sim://sflr", rows=3000, progress=lambda row, total: display())
    assert result.counts.samples == 3000 and rows.sinks[-1].closed
    assert time.monotonic() - begun < 20.0


def test_a_device_at_another_rate_is_refused_before_a_log_is_made(rows):
    slow = rows.rig.model_copy(update={"sample_rate": 250.0})
    with pytest.raises(UsageError, match="the device runs at 500 Hz, rig sflr at sample_rate = 250"):
        rows.test_at("sim://sflr", rig=slow)
    assert rows.sinks == []


def test_an_arm_that_does_not_come_to_rest_is_refused_before_a_log_is_made(rows, monkeypatch):
    monkeypatch.setattr("station.loop.run_test.SETTLE_SECONDS", 0.5)
    with open_port("sim://sflr") as port:
        device, count = port.serial.device, iter(range(10**6))
        monkeypatch.setattr(device._source, "sample", lambda: (3 * next(count), 0))
        with pytest.raises(WorkError, match=r"the arm still moves after 0.5 s"):
            rows.test(port, relative=True)
    assert rows.sinks == []


@pytest.mark.parametrize("reference", [[], [1.0], [0.0, np.nan], [[0.0, 1.0]]])
def test_a_reference_that_is_none_is_refused(rows, reference):
    with pytest.raises(UsageError, match="reference"):
        rows.test_at("sim://sflr", reference=np.array(reference))


def test_a_log_replayed_as_a_device_is_answered_with_its_own_commands(rows, tmp_path):
    from station.runs import export_run, load_run

    rows.test_at("sim://sflr?noise=1&seed=2", LEAD_ACCEL, accel_zero=0.5)
    export_run(rows.run, tmp_path / "run.csv")
    run = load_run(tmp_path / "run.csv")
    rows.test_at(f"replay://{tmp_path / 'run.csv'}", LEAD_ACCEL, accel_zero=0.5, reference=run.reference)
    assert np.array_equal(rows.run.command, run.command)
    assert np.array_equal(rows.run.encoder, run.encoder)


def test_every_kind_of_test_runs(rows):
    for test in ({"kind": "pulse", "duration": 0.8}, {"kind": "sweep", "duration": 1.0, "rest": 0.2, "f1": 20.0},
                 {"kind": "multisine", "duration": 1.0}, {"kind": "prbs", "duration": 1.0}):
        reference = reference_from_test(test, 500.0)
        result = rows.test_at("sim://sflr", {"kind": "p", "gain": 1.0}, reference=reference)
        assert result.counts.samples == len(reference)


def test_in_real_time_every_tick_is_accounted_for(rows):
    """A busy machine may be late, or fault the device; either way the figures add up."""
    fault = None
    with open_port("sim://sflr?speed=1") as port:
        try:
            rows.test(port, rows=300)
        except WorkError as error:
            fault = str(error)
        core = port.serial.device.core
        assert core.drive == 0
        assert core.state in (State.IDLE, State.FAULT)
    run, counts = rows.run, rows.sinks[-1].metadata.model_extra["counts"]
    assert fault is None or "in fault (host silent)" in fault or "fell silent" in fault
    assert counts["lost"] == counts["corrupt"] == counts["duplicated"] == 0
    assert counts["samples"] == len(run) == counts["device_samples"] - counts["after_stop"]
    missed = (run.status & (Status.HELD | Status.ZEROED)) != 0
    assert counts["unanswered"] == np.count_nonzero(missed)
    assert np.array_equal(run.command[1:][~missed[1:]], run.command_sent[:-1][~missed[1:]])
    assert run.metadata.model_extra["clock"] == "real"
    assert np.all(np.diff(run.device_time) > 0.0)


def test_the_interpreter_is_left_as_it_was(rows):
    interval, seen = sys.getswitchinterval(), []

    def sink(metadata):
        made = rows.sink(metadata)
        made.append = lambda row: seen.append((gc.isenabled(), sys.getswitchinterval()))
        return made

    with contextlib.suppress(WorkError):  # a busy machine may fault the device
        rows.test_at("sim://sflr?speed=1", rows=120, log_sink=sink)
    assert seen[0] == (False, pytest.approx(1e-4))
    assert gc.isenabled()
    assert sys.getswitchinterval() == interval


def test_a_biased_amplifier_moves_the_arm_in_a_session_alone(rows, tmp_path):
    biased = rows.rig.with_effects([CommandBias(at="amplifier", offset=6.0)])
    path = tmp_path / "rig.toml"
    path.write_text(biased.to_toml())
    with open_port(f"sim://?rig={path}") as port:
        client = Client(port)
        client.identify()
        client.wait(1.0)
        assert client.wait_for_rest() == 0
        rows.test(port)
        assert np.array_equal(simulate(biased, rows.run).encoder, rows.run.encoder)
        assert rows.run.encoder[99] != 0  # it drifts in the rest before the step, as on the model
        result = rows.test(port, relative=True, accel_zero=None)  # each test begins at rest all the same
        assert result.counts.samples == 600
        assert rows.run.encoder[0] == rows.run.reference[0]
