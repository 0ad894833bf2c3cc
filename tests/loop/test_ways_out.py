"""However a test ends, the motor is at zero and the log is closed."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

from station.control.compensators import Compensator
from station.device.client import Client
from station.device.port import open_port
from station.device.protocol import State
from station.device.server import DeviceProcess
from station.errors import WorkError
from station.loop.engine import CONFIRMED, UNCONFIRMED
from station.loop.run_test import identify_clear
from station.loop.sink import MemorySink

ROW = 200  # well into the step: the motor is driven


class Ends(Compensator):
    """A lead compensator that fails at a row."""

    error: BaseException

    def step(self, reference, encoder, accel):
        self.rows = getattr(self, "rows", 0) + 1
        if self.rows == ROW:
            raise self.error
        return super().step(reference, encoder, accel)


def ending(rows, error):
    made = rows.compensator()
    made.__class__, made.error = Ends, error
    return made


def at_rest(port):
    core = port.serial.device.core
    return core.state == State.IDLE and core.drive == 0


def test_the_end(rows):
    with open_port("sim://sflr") as port:
        rows.test(port)
        assert at_rest(port)


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt(), SystemExit(3), MemoryError(), WorkError("x")])
def test_whatever_is_raised_in_the_compensator(rows, error):
    with open_port("sim://sflr") as port:
        with pytest.raises(type(error)):
            rows.test(port, compensator=ending(rows, error))
        assert at_rest(port)
        assert rows.sinks[-1].closed
        assert len(rows.run) == ROW  # the sample that was not answered is logged too
        assert np.isnan(rows.run.command_sent[-1])
        assert rows.run.command[-1] != 0.0
        rows.test(port, relative=True)  # and the next test runs
        assert len(rows.run) == 600


@pytest.mark.parametrize("error", [WorkError("disk full"), KeyboardInterrupt()])
def test_a_log_that_fails(rows, error):
    with open_port("sim://sflr") as port:
        def failing(metadata):
            sink = rows.sink(metadata)
            keep = sink.rows.append

            def append(row):
                keep(row)
                if row[0] == ROW:
                    raise error
            sink.append = append
            return sink
        with pytest.raises(type(error)):
            rows.test(port, log_sink=failing)
        assert at_rest(port)


def test_a_controller_that_overflows_is_told_with_its_row_and_the_motor_is_at_zero(rows, recwarn):
    unstable = {"kind": "lead_accel", "gain": 1.0, "zero": 5.0, "pole": 50.0, "accel_numerator": [1.0, 0.0],
                "accel_denominator": [1.0, -9.0]}
    with open_port("sim://sflr") as port:
        with pytest.raises(WorkError, match=rf"^sim://sflr: the controller's command was no number at row \d+, .*"
                                            rf"{CONFIRMED}$") as told:
            rows.test(port, unstable)
        assert at_rest(port)
    assert f"at row {len(rows.run) - 1}," in str(told.value)
    assert rows.sinks[-1].metadata.model_extra["outcome"] == str(told.value)
    assert not [warning for warning in recwarn if warning.category is RuntimeWarning]


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(("error", "outcome"), [(None, "complete"), (KeyboardInterrupt(), "interrupted"),
                                                (WorkError("no room"), f"no room; {CONFIRMED}")])
def test_ctrl_c_while_a_test_ends_waits_for_its_log_to_be_closed(rows, error, outcome):
    """Pressed twice or more, as people do: the outcome says why all the same."""
    before = signal.getsignal(signal.SIGINT)

    class Pressed(MemorySink):
        def update(self, metadata):
            signal.raise_signal(signal.SIGINT)
            super().update(metadata)

        def close(self):
            signal.raise_signal(signal.SIGINT)
            super().close()

    def sink(metadata):
        rows.sinks.append(Pressed(metadata))
        return rows.sinks[-1]

    with open_port("sim://sflr") as port:
        with pytest.raises(KeyboardInterrupt if error is None else type(error)):
            rows.test(port, log_sink=sink, compensator=error and ending(rows, error))
        assert at_rest(port)
    assert rows.sinks[-1].closed and rows.sinks[-1].metadata.model_extra["outcome"] == outcome
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_gets_through_where_a_log_hangs(rows, monkeypatch):
    monkeypatch.setattr("station.loop.run_test.HANGS", 0.0)

    class Hangs(MemorySink):
        def close(self):
            signal.raise_signal(signal.SIGINT)
            pytest.fail("it waited on")

    with open_port("sim://sflr") as port, pytest.raises(KeyboardInterrupt):
        rows.test(port, log_sink=Hangs)


def test_a_log_that_cannot_be_made_arms_nothing(rows, monkeypatch):
    """Whatever ends the making of the log, the device is idle: it was never armed."""
    for error in (WorkError("no room"), KeyboardInterrupt()):
        def refuse(metadata, error=error):
            raise error
        with open_port("sim://sflr") as port:
            with monkeypatch.context() as patch:
                patch.setattr(Client, "arm", lambda self: pytest.fail("armed"))
                with pytest.raises(type(error)):
                    rows.test(port, log_sink=refuse)
            assert at_rest(port)
            rows.test(port)


@pytest.mark.parametrize("at", range(12))
def test_ctrl_c_at_any_request_of_the_beginning_leaves_the_device_idle(rows, at):
    """The interrupt comes right after the at-th write: identify, configure, arm, start and what lies between."""
    with open_port("sim://sflr") as port:
        serial, write, writes = port.serial, port.serial.write, []

        def interrupted(data):
            done = write(data)
            writes.append(data)
            if len(writes) == at + 1:
                raise KeyboardInterrupt
            return done

        serial.write = interrupted
        with pytest.raises(KeyboardInterrupt):
            rows.test(port)
        assert at_rest(port)
        assert all(sink.closed for sink in rows.sinks)
        serial.write = write
        assert rows.test(port).counts.samples == 600


@pytest.mark.parametrize("error", [WorkError("refused"), KeyboardInterrupt()])
def test_what_breaks_between_arm_and_start_leaves_the_device_idle(rows, error, monkeypatch):
    def broken(self):
        raise error
    with open_port("sim://sflr") as port:
        monkeypatch.setattr(Client, "start", broken)
        with pytest.raises(type(error)):
            rows.test(port)
        assert at_rest(port)
        assert rows.sinks[-1].closed


def test_the_abort_key_takes_the_motor_to_zero_within_one_tick(rows):
    abort = threading.Event()

    def sink(metadata):
        made = rows.sink(metadata)
        keep = made.rows.append

        def append(row):
            keep(row)
            if row[0] == ROW:
                abort.set()
        made.append = append
        return made

    with open_port("sim://sflr") as port:
        with pytest.raises(KeyboardInterrupt):
            rows.test(port, log_sink=sink, abort=abort)
        assert at_rest(port)
        counts = rows.sinks[-1].metadata.model_extra["counts"]
    assert len(rows.run) == ROW + 2  # the sample that came next was answered by the stop
    assert rows.run.command[ROW + 1] != 0.0 and counts["after_stop"] == 0
    assert counts["device_samples"] == len(rows.run)
    assert rows.sinks[-1].metadata.model_extra["outcome"] == "interrupted"


def test_an_abort_before_the_log_is_made_drives_no_motor(rows):
    abort = threading.Event()
    abort.set()
    with open_port("sim://sflr") as port:
        with pytest.raises(KeyboardInterrupt):
            rows.test(port, abort=abort)
        assert at_rest(port)
    assert not rows.sinks


def test_a_pulled_cable_is_told_and_the_watchdog_takes_the_motor_to_zero(rows):
    with open_port(f"sim://sflr?unplug_after={ROW}") as port:
        device = port.serial.device
        with pytest.raises(WorkError, match=r"the line was lost .* check cable and device; " + UNCONFIRMED):
            rows.test(port)
        assert UNCONFIRMED in rows.sinks[-1].metadata.model_extra["outcome"]
        assert device.core.running  # no stop can reach it
        assert device.core.drive != 0
        drives = [device.core.tick(i, 0, 0) for i in range(12)]
        assert not any(drives[2:])
        assert device.core.state == State.FAULT
    assert rows.sinks[-1].closed
    assert len(rows.run) == ROW
    assert np.isnan(rows.run.latency[-1])


def test_a_motor_is_said_to_be_at_zero_only_where_the_device_has_confirmed_it(rows):
    """The same two ways out, on a line that carries the stop and on one that does not."""
    request = Client._request

    def deaf(self, name, *given, **values):
        if name == "stop":
            raise WorkError("no answer to stop")
        return request(self, name, *given, **values)

    for error, confirmed in ((WorkError("no room"), f"no room; {CONFIRMED}"), (KeyboardInterrupt(), "")):
        with open_port("sim://sflr") as port:
            with pytest.raises(type(error)) as told:
                rows.test(port, compensator=ending(rows, error))
            assert str(told.value) == confirmed and port.serial.device.core.drive == 0
        with open_port("sim://sflr") as port, pytest.MonkeyPatch.context() as patch:
            patch.setattr(Client, "_request", deaf)
            with pytest.raises(type(error)) as told:
                rows.test(port, compensator=ending(rows, error))
            assert UNCONFIRMED in str(told.value) and CONFIRMED not in str(told.value)


def test_what_fails_before_a_session_says_nothing_of_the_motor(rows, monkeypatch):
    def refused(self, *given, **more):
        raise WorkError("refused")

    monkeypatch.setattr(Client, "configure", refused)
    with pytest.raises(WorkError) as told:
        rows.test_at("sim://sflr")
    assert str(told.value) == "refused"


def test_a_device_that_falls_silent_is_told(rows):
    with open_port(f"sim://sflr?silent_after={ROW}") as port, pytest.raises(
            WorkError, match=f"the device fell silent after row {ROW - 2}"):
        rows.test(port)
    assert rows.sinks[-1].closed


HOST = textwrap.dedent("""
    import sys
    from station.control.compensators import Compensator
    from station.control.references import reference_from_test
    from station.device.port import open_port
    from station.loop.run_test import run_test
    from station.loop.sink import MemorySink
    from station.rig import load_rig
    rig = load_rig("sflr")
    compensator = Compensator.from_spec({"kind": "open"}, 500.0, 200.0)
    def progress(row, rows):
        if row >= 150:
            print("driving", flush=True)
    with open_port(sys.argv[1]) as port:
        run_test(port, rig, compensator, reference_from_test({"kind": "step", "duration": 60.0}, 500.0),
                 log_sink=MemorySink, progress=progress, accel_zero=0.0, relative=False)
""")


def host_at(url, until):
    """A host in its own process, driving the motor; ended by ``until``; its exit status and its last words."""
    host = subprocess.Popen([sys.executable, "-c", HOST, url], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            text=True)
    try:
        assert "driving" in host.stdout.readline(), host.stderr.read()
        until(host)
        return host.wait(timeout=30), host.stderr.read()
    finally:
        host.kill()
        host.wait()
        host.stdout.close()
        host.stderr.close()


@pytest.fixture(scope="module")
def device():
    """In lockstep, so that a busy machine faults no host; once a host has hung up it ticks in real time."""
    if sys.platform == "win32":
        pytest.skip("signals of POSIX")
    with DeviceProcess("sflr", speed=0) as served:
        yield served


def test_a_killed_host_leaves_a_device_in_fault_with_its_motor_at_zero(device):
    host_at(device.addresses.tcp, lambda host: os.kill(host.pid, signal.SIGKILL))
    time.sleep(0.3)
    with open_port(device.addresses.tcp) as port:
        client = Client(port)
        assert client.identify().state == State.FAULT
        found = client.statistics()
        assert (found.held, found.zeroed) == (1, 9)
        client.wait_for_rest()


def test_ctrl_c_stops_the_device(device):
    for url in (device.addresses.pty, device.addresses.tcp):
        with open_port(url) as port:
            identify_clear(Client(port))
        status, words = host_at(url, lambda host: host.send_signal(signal.SIGINT))
        assert status != 0
        assert "KeyboardInterrupt" in words
        with open_port(url) as port:
            client = Client(port)
            assert client.identify().state == State.IDLE
            found = client.statistics()
            assert (found.held, found.zeroed) == (0, 0)
            client.wait_for_rest()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_device_is_told_in_one_line(rows):
    with DeviceProcess("sflr", pty=False, speed=0) as served, open_port(served.addresses.tcp) as port:
        def sink(metadata):
            made = rows.sink(metadata)
            keep = made.rows.append
            made.append = lambda row: (keep(row), served.process.kill() if row[0] == ROW else None)
            return made
        with pytest.raises(WorkError) as told:
            rows.test(port, log_sink=sink)
    assert "\n" not in str(told.value)
    assert served.addresses.tcp in str(told.value)
    assert rows.sinks[-1].closed
