"""A line that brings bytes but no samples ends a test as one that brings nothing does; nothing waits for ever."""

import threading
import time

import pytest

from station.device.client import ANSWER_SECONDS, TRIES, Client
from station.device.framing import encode
from station.device.port import Port, open_port
from station.device.protocol import MESSAGES, State
from station.errors import WorkError
from station.loop.engine import SILENCE_SECONDS
from station.loop.loopback import loopback


class Babbling:
    """A pyserial-like line on which one byte comes every 80 ms (12 a second), whatever is written."""

    def __init__(self, byte: bytes) -> None:
        self._byte = byte

    in_waiting = 0

    def read(self, size: int) -> bytes:
        time.sleep(0.08)
        return self._byte

    def write(self, data: bytes) -> int:
        return len(data)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("byte", [b"U", b"\0"])
def test_a_line_that_babbles_holds_no_request_up(byte):
    begun = time.monotonic()
    with pytest.raises(WorkError, match=r"not a Station device \(\d+ bytes came"):
        loopback(Port("babbling", Babbling(byte)))
    assert time.monotonic() - begun < 2.0 * TRIES * ANSWER_SECONDS + 1.0


class Turns:
    """A port that from a tick of the session on gives something else than what the device sends."""

    def __init__(self, port, after, instead):
        self._serial, self._after, self._instead = port.serial, after, instead
        self._frames = 0
        port.serial = self

    def __getattr__(self, name):
        return getattr(self._serial, name)

    def read(self, size):
        data = self._serial.read(size)
        if self._serial.device.core.running or self._frames > self._after:
            self._frames += data.count(b"\0")
            if self._frames > self._after:
                time.sleep(0.02)
                return self._instead(self, data)
        return data


def noise(line, data):
    return b"\x55\0"


def the_same_sample(line, data):
    line.last = getattr(line, "last", data)
    return line.last


@pytest.mark.parametrize("instead", [noise, the_same_sample])
def test_a_line_that_babbles_in_a_session_is_lost(rows, instead, monkeypatch):
    """Frames that do not pass and samples that came before are no sign of life."""
    monkeypatch.setattr("station.loop.engine.VIRTUAL_SILENCE_SECONDS", SILENCE_SECONDS)
    with open_port("sim://sflr") as port:
        core = port.serial.device.core
        Turns(port, 150, instead)
        begun = time.monotonic()
        with pytest.raises(WorkError, match="no sample came after row"):
            rows.test(port)
        assert time.monotonic() - begun < 10.0
        assert core.state in (State.IDLE, State.FAULT) and core.drive == 0
    assert rows.sinks[-1].closed and 140 < len(rows.run) < 160


def test_a_device_in_virtual_time_that_a_busy_machine_starves_is_waited_for(rows):
    """Its process does not run for a second: its time stands still, and nothing is lost."""
    waits = []
    with open_port("sim://sflr") as port:
        read = port.read

        def starved(size):
            if port.serial.device.core.drive and len(waits) < 10:
                waits.append(time.sleep(0.1))
                return b""
            return read(size)

        port.read = starved
        result = rows.test(port)
    assert len(waits) == 10
    assert (result.counts.samples, result.counts.lost, result.counts.unanswered) == (600, 0, 0)


def test_a_stranger_that_answers_is_no_device():
    """An HTTP server's answer, and frames that pass but answer nothing."""
    class Stranger(Babbling):
        def read(self, size):
            time.sleep(0.01)
            return self._byte

    for said in (b"HTTP/1.1 400 Bad Request\r\n\r\n", encode(MESSAGES["reply"].pack(
            request=1, result=0, state=0, fault=0, status=0, encoder=0))):
        with pytest.raises(WorkError, match="not a Station device"):
            Client(Port("stranger", Stranger(said))).identify()


def test_a_host_that_stalls_is_told_by_the_device_and_its_samples_still_add_up(rows):
    """1 and 5 ms: nothing but late answers; 50 ms: the device's fault.  In real time, so that stalls are real."""
    for stall, faulted in ((0.001, False), (0.005, False), (0.05, True)):
        done = threading.Event()

        def sink(metadata, stall=stall, done=done):
            made = rows.sink(metadata)
            keep = made.rows.append

            def append(row):
                keep(row)
                if row[0] == 150:
                    time.sleep(stall)
                    done.set()
            made.append = append
            return made

        fault = None
        with open_port("sim://sflr?speed=1") as port:
            try:
                rows.test(port, rows=300, log_sink=sink, spec={"kind": "open"})
            except WorkError as error:
                fault = str(error)
            assert port.serial.device.core.drive == 0
        counts = rows.sinks[-1].metadata.model_extra["counts"]
        assert done.is_set()
        assert counts["device_samples"] + counts["unsent"] == counts["samples"] + counts["lost"] + counts["after_stop"]
        assert (fault is not None) or not faulted  # a busy machine may fault the device at a shorter stall, too
        assert fault is None or "in fault (host silent)" in fault
