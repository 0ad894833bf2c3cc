"""Each fault of device, sensors, drive and cable: the motor is at zero, every sample that was sent is accounted for,
one line says what happened, nothing resumes by itself, and the user's next command runs."""

from contextlib import contextmanager

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.client import Client
from station.device.core import Core
from station.device.limits import SPEED_TICKS
from station.device.port import open_port
from station.device.protocol import InputFlags, State
from station.device.simulated import SimulatedDevice
from station.errors import UsageError, WorkError
from station.loop.check import check
from station.loop.engine import CONFIRMED, UNCONFIRMED
from station.rig import Limits, load_rig

ROW = 250
P = {"kind": "p", "gain": 2.0}
LIMITED = load_rig("sflr").model_copy(update={"limits": Limits(travel=2.0, speed=40.0)})


class Bench:
    """A simulated rig whose sensors and inputs a test can spoil from a tick of the session on."""

    def __init__(self, port):
        self.port, self.device = port, port.serial.device

    @contextmanager
    def spoiled(self, sensors=None, flags=0, at=ROW):
        """``sensors(encoder, accel, ticks since)`` in place of the readings; ``flags`` as the board's inputs."""
        device, source = self.device, self.device._source
        sample, core_tick = source.sample, device.core.tick
        seen = []

        def spoil():
            read = sample()
            if sensors is not None and device.core.running and device.core._core.next_index >= at:
                seen.append(read)
                return sensors(*read, len(seen), seen[0])
            return read

        def tick(clock, encoder, accel, given=0):
            on = flags if device.core.running and device.core._core.next_index >= at else 0
            return core_tick(clock, encoder, accel, given | on)

        source.sample, device.core.tick = spoil, tick
        try:
            yield
        finally:
            source.sample, device.core.tick = sample, core_tick


@pytest.fixture
def bench():
    with open_port("sim://sflr?noise=1&seed=5") as port:
        yield Bench(port)


def afterwards(rows, bench, rig=None):
    """The motor is at zero and stays there, all samples are accounted for, and the next test runs."""
    core = bench.device.core
    assert core.drive == 0 and core.state in (State.IDLE, State.FAULT)
    counts = rows.sinks[-1].metadata.entries()["counts"]
    if counts["device_samples"] >= 0:
        assert counts["device_samples"] + counts["unsent"] == \
            counts["samples"] + counts["lost"] + counts["after_stop"]
    assert counts["samples"] == len(rows.sinks[-1].rows) and rows.sinks[-1].closed
    assert rows.sinks[-1].metadata.entries()["outcome"] not in ("complete", "running")
    state = core.state
    for _ in range(3):
        Client(bench.port).wait(0.2)
        assert core.drive == 0 and core.state == state  # nothing arms or resumes by itself
    again = rows.test(bench.port, P, relative=True, rig=rig or rows.rig)
    assert again.counts.samples == 600 and rows.sinks[-1].metadata.entries()["outcome"] == "complete"


def test_an_encoder_that_stands_still_under_a_large_command(rows, bench):
    with bench.spoiled(lambda encoder, accel, ticks, first: (first[0], accel), at=90), pytest.raises(
            WorkError, match=r"200 counts for 0.5 s and the encoder stood still; stopped at row 3[45]\d.*" + CONFIRMED):
        rows.test(bench.port, P)
    afterwards(rows, bench)


def test_an_encoder_that_jumps(rows, bench):
    jump = lambda encoder, accel, ticks, first: (encoder + 150 * (ticks > 3), accel)  # noqa: E731
    with bench.spoiled(jump), pytest.raises(
            WorkError, match=rf"moved \d+ counts in {SPEED_TICKS} ticks, the limit|in fault \(speed\)"):
        rows.test(bench.port, P, rig=LIMITED)
    assert len(rows.run) <= ROW + 6
    afterwards(rows, bench, LIMITED)


def test_an_encoder_that_counts_the_wrong_way_runs_into_the_travel_limit(rows, bench):
    """As only --force lets it: `station check` has named it before."""
    wrong = lambda encoder, accel, ticks, first: (-encoder, accel)  # noqa: E731
    with bench.spoiled(wrong, at=0):
        assert not check(bench.port, rows.rig).passed
        with pytest.raises(WorkError, match=r"the arm went \d+ counts from where it began|in fault \(travel\)"):
            rows.test(bench.port, P, rig=LIMITED, relative=True)
    assert np.max(np.abs(rows.run.encoder - rows.run.encoder[0])) < 345
    afterwards(rows, bench, LIMITED)


def test_motor_leads_that_are_swapped_run_into_the_travel_limit(rows, bench):
    own = bench.device._source
    turned = SimulatedDevice.of_rig(rows.rig.with_constants({"motor.gain": -rows.rig.motor.gain}))._source
    bench.device._source = turned
    assert check(bench.port, rows.rig).motor == -1
    with pytest.raises(WorkError, match=r"the arm went \d+ counts from where it began|in fault \(travel\)"):
        rows.test(bench.port, P, rig=LIMITED, relative=True)
    bench.device._source = own
    afterwards(rows, bench, LIMITED)


def test_an_e_stop_that_is_pressed(rows, bench):
    with bench.spoiled(flags=int(InputFlags.ESTOP)), pytest.raises(
            WorkError, match=r"in fault \(estop\) at row 2[45]\d; its e-stop is open; close it.*; " + CONFIRMED):
        rows.test(bench.port, P)
    core_tick = bench.device.core.tick
    bench.device.core.tick = lambda clock, encoder, accel, flags=0: core_tick(
        clock, encoder, accel, flags | int(InputFlags.ESTOP))
    with pytest.raises(WorkError, match="e-stop|estop"):  # while it is open nothing starts
        rows.test(bench.port, P, relative=True)
    bench.device.core.tick = core_tick
    Client(bench.port).wait(0.1)
    afterwards(rows, bench)


def test_a_cable_that_is_pulled_and_put_back(rows, bench):
    faults = bench.device.options.faults
    bench.device._session_ticks = 0
    object.__setattr__(faults, "unplug_after", ROW)
    with pytest.raises(WorkError, match=r"the line was lost .* check cable and device; " + UNCONFIRMED):
        rows.test(bench.port, P)
    object.__setattr__(faults, "unplug_after", None)
    Client(bench.port).wait(0.5)  # the watchdog has had its time
    assert bench.device.core.state == State.FAULT
    afterwards(rows, bench)


@pytest.mark.parametrize("silent_for", [60, 400])
def test_a_device_that_is_silent_for_a_while(rows, bench, silent_for):
    faults = bench.device.options.faults
    bench.device._session_ticks = 0
    object.__setattr__(faults, "silent_after", ROW)
    with pytest.raises(WorkError, match=r"the device fell silent after row .*; " + UNCONFIRMED):
        rows.test(bench.port, P)
    object.__setattr__(faults, "silent_after", None)
    Client(bench.port).wait(silent_for / 500.0)
    assert bench.device.core.drive == 0
    afterwards(rows, bench)


def test_a_device_that_is_reset_is_another_power_up(rows, bench, monkeypatch, tmp_path):
    """Its session is gone, its encoder's zero is another, and a closed loop wants a new check."""
    from station.loop import checked

    monkeypatch.setattr(checked, "is_simulated", lambda url, identity: False)
    monkeypatch.setattr(checked, "store", lambda: tmp_path / "checks.json")
    assert check(bench.port, rows.rig).passed
    device, before = bench.device, Client(bench.port).identify()

    class Resets(Compensator):
        def step(self, reference, encoder, accel):
            self.rows = getattr(self, "rows", 0) + 1
            if self.rows == ROW:
                other = SimulatedDevice.of_rig(rows.rig).core
                device.core = other
                assert isinstance(other, Core)
            return super().step(reference, encoder, accel)

    made = rows.compensator(P)
    made.__class__ = Resets
    with pytest.raises(WorkError, match=r"fell silent|no sample came"):
        rows.test(bench.port, compensator=made, relative=True)
    assert device.core.state == State.IDLE and device.core.drive == 0
    after = Client(bench.port).identify()
    assert after.boot != before.boot and after.zero_id != before.zero_id
    with pytest.raises(UsageError, match="no passed check of this device"):
        rows.test(bench.port, P, relative=True)
    assert check(bench.port, rows.rig).passed
    assert rows.test(bench.port, P, relative=True).counts.samples == 600


@pytest.mark.parametrize("reading", [123, 32767, -32767], ids=["stuck", "saturated", "saturated the other way"])
def test_an_accelerometer_that_is_stuck_or_saturated_is_named_by_the_check_and_drives_nothing(rows, bench, reading):
    stuck = lambda encoder, accel, ticks, first: (encoder, reading)  # noqa: E731
    spec = {"kind": "lead_accel", "gain": 20.0, "zero": 31.4159, "pole": 125.6637,
            "accel_numerator": [0.00045097, 0.00045152, -0.00044989, -0.00045043],
            "accel_denominator": [1.0, -2.9289362, 2.85853684, -0.92960052]}
    with bench.spoiled(stuck, at=0):
        found = check(bench.port, rows.rig)
        assert not found.passed and any("accelerometer is dead" in words for words in found.words)
        rows.test(bench.port, spec, relative=True, accel_zero=None)  # as only --force lets it on a rig that may be real
    assert rows.run.metadata.accel_zero == reading
    assert np.max(np.abs(rows.run.command[:100])) <= 2.0  # it is taken for the zero: it moves nothing by itself
    assert rows.test(bench.port, P, relative=True).counts.samples == 600


def test_a_viewer_that_is_lost_leaves_the_run_complete(rows, bench):
    from station.view.live import LiveView, LogAndView

    views, told = [], []

    class Lost(LiveView):
        def _work(self, url):
            self.failure, self._capacity = "the viewer was killed", 0

    def sink(metadata):
        views.append(Lost(rows.rig, url="rerun+http://127.0.0.1:1/proxy"))
        return LogAndView(rows.sink(metadata), views[-1], told.append)

    result = rows.test(bench.port, P, log_sink=sink)
    assert result.counts.samples == 600 == len(rows.run)
    assert views[0].failure == "the viewer was killed" and views[0].dropped == 600
    assert told == ["the live view missed 600 rows (the viewer was killed); the log is written apart from it"]
