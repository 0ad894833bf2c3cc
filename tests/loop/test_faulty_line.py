"""Every fault put into the line appears in the counters, exactly, and none of them leaves the motor driven."""

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.port import open_port
from station.device.protocol import State, Status
from station.errors import WorkError


def with_faults(rows, faults, seed=1, count=1500):
    with open_port(f"sim://sflr?seed={seed}&{faults}") as port:
        result = rows.test(port, rows=count)
        line = port.serial.device.line
        return result.counts, line, rows.run


def beyond(counts):
    """Samples lost behind the last row: nobody waits for them."""
    return max(counts.after_stop - 1, 0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lost_samples_are_counted_and_never_filled(rows, seed):
    counts, line, run = with_faults(rows, "drop=0.03&on=sample", seed)
    dropped = line.counts["sample", "drop"]
    assert dropped > 20
    assert counts.lost == dropped - beyond(counts)
    assert counts.samples == len(run) == 1500 - counts.lost
    assert counts.device_samples == counts.samples + counts.lost + counts.after_stop
    assert np.array_equal(run.t, run.n / 500.0)
    assert run.lost_samples == counts.lost - (1499 - run.n[-1]) - run.n[0]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lost_commands_are_held_ticks(rows, seed):
    counts, line, run = with_faults(rows, "drop=0.03&on=command", seed)
    dropped = line.counts["command", "drop"]
    assert dropped > 20
    assert counts.lost == 0
    assert counts.commands == 1500 - dropped
    assert counts.unanswered == counts.held + counts.zeroed
    assert counts.unanswered in (dropped, dropped - 1)  # the last command, 0 with the stop, has no tick
    missed = (run.status & (Status.HELD | Status.ZEROED)) != 0
    answered = ~missed[1:]
    assert np.array_equal(run.command[1:][answered], run.command_sent[:-1][answered])
    held = (run.status[1:] & Status.HELD) != 0
    assert np.array_equal(run.command[1:][held], run.command[:-1][held])
    assert not np.any(run.command[(run.status & Status.ZEROED) != 0])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_flipped_bits_are_corrupt_frames_on_the_side_that_got_them(rows, seed):
    counts, line, _ = with_faults(rows, "flip=0.02", seed)
    assert min(line.counts["sample", "flip"], line.counts["command", "flip"]) > 10
    assert counts.corrupt == line.counts["sample", "flip"]
    assert counts.device_corrupt == line.counts["command", "flip"]
    assert counts.lost == counts.corrupt - beyond(counts)
    assert counts.commands == counts.samples - counts.device_corrupt


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_repeated_frames_are_counted_and_used_once(rows, seed):
    counts, line, run = with_faults(rows, "duplicate=0.03", seed)
    assert min(line.counts["sample", "duplicate"], line.counts["command", "duplicate"]) > 20
    assert counts.duplicated == line.counts["sample", "duplicate"]
    assert counts.repeated == line.counts["command", "duplicate"]
    assert (counts.lost, counts.corrupt, counts.unanswered, counts.samples) == (0, 0, 0, 1500)
    assert len(set(run.n.tolist())) == 1500


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_late_commands_are_counted_and_never_used(rows, seed):
    counts, line, run = with_faults(rows, "late=0.03", seed)
    late = line.counts["command", "late"] - (1 if line._late else 0)
    assert late > 20
    assert counts.late == counts.held + counts.zeroed == late
    assert np.count_nonzero(run.status & Status.LATE) in (late, late - 1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_samples_that_were_overtaken_are_lost_and_told_apart_from_those_that_come_twice(rows, seed):
    counts, line, run = with_faults(rows, "reorder=0.03&on=sample", seed)
    overtaken = line.counts["sample", "reorder"]
    assert overtaken > 20
    assert counts.lost == overtaken - beyond(counts)
    assert counts.reordered in (counts.lost, counts.lost - 1)  # the last one may still be on its way
    assert counts.duplicated == counts.corrupt == 0
    assert np.all(np.diff(run.n) > 0)
    assert counts.device_samples == counts.samples + counts.lost + counts.after_stop


def test_all_of_them_together_still_add_up(rows):
    counts, line, run = with_faults(rows, "drop=0.01&flip=0.01&duplicate=0.01&late=0.01", 7, 4000)
    assert counts.samples == len(run)
    assert counts.lost == line.counts["sample", "drop"] + line.counts["sample", "flip"] - beyond(counts)
    assert counts.samples + counts.lost == 4000
    assert counts.device_samples == 4000 + counts.after_stop
    assert counts.commands + counts.held + counts.zeroed in (counts.device_samples - 1, counts.device_samples)
    assert np.all(np.abs(run.command) <= 200)


def test_a_device_that_goes_into_fault_ends_the_test_and_says_why(rows):
    with open_port("sim://sflr?drop=1&on=command") as port:
        with pytest.raises(WorkError, match=r"the device went in fault \(host silent\) at row 10") as told:
            rows.test(port)
        assert "\n" not in str(told.value)
        core = port.serial.device.core
        assert core.state == State.FAULT
        assert core.drive == 0
    assert rows.sinks[-1].closed
    assert rows.sinks[-1].metadata.model_extra["counts"]["zeroed"] == 9
    assert len(rows.run) == 11


def test_the_next_test_clears_the_fault_that_the_last_one_left(rows):
    with open_port("sim://sflr?drop=1&on=command") as port:
        with pytest.raises(WorkError, match="in fault"):
            rows.test(port)
        port.serial.device._faulty = False  # the line is mended
        assert rows.test(port).counts.samples == 600


def test_a_sample_that_comes_again_after_the_last_row_is_counted_too(rows):
    counts, line, _ = with_faults(rows, "duplicate=1&on=sample", count=300)
    assert counts.duplicated == line.counts["sample", "duplicate"] == counts.device_samples == 300


def test_the_compensator_steps_once_for_every_tick_lost_ones_included(rows):
    steps = []

    class Counting(Compensator):
        def step(self, reference, encoder, accel):
            steps.append((reference, encoder))
            return super().step(reference, encoder, accel)

    made = rows.compensator()
    made.__class__ = Counting
    reference = np.where(np.arange(600) < 100, 0.0, np.arange(600.0) / 10.0)
    with open_port("sim://sflr?drop=0.05&on=sample&seed=2") as port:
        result = rows.test(port, compensator=made, reference=reference)
    assert result.counts.lost > 10
    assert [step[0] for step in steps] == reference[1:].tolist()
    encoders = dict(zip(rows.run.n.tolist(), rows.run.encoder.tolist(), strict=True))
    last = 0
    for row, (_, encoder) in enumerate(steps):  # a lost row is stepped with what was read last
        last = encoders.get(row, last)
        assert encoder == last
