"""`station loopback` names the cause of a line that does not carry a test, and what to do about it."""

import sys
import time

import pytest
import serial

from station.device.framing import Decoder, encode
from station.device.port import Port, open_port
from station.device.protocol import MESSAGES
from station.device.server import DeviceProcess
from station.errors import WorkError
from station.loop import remedies
from station.loop.loopback import loopback
from station.model.effects.clock_scale import ClockScale

IDENTITY = MESSAGES["identity"]


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminal here")
@pytest.mark.parametrize("right", [115_200, 9_600])
def test_a_wrong_baud_rate_is_found_out(right):
    class Uart(serial.Serial):
        """Garbles what passes at another baud rate than the board's, as a UART does."""

        def write(self, data):
            return super().write(data if self.baudrate == right else bytes(b ^ 0xA5 for b in data))

        def read(self, size=1):
            data = super().read(size)
            return data if self.baudrate == right else bytes(b ^ 0x5A for b in data)

    with DeviceProcess("sflr", tcp=False, speed=0) as served:
        line = Uart(served.addresses.pty, 921_600, timeout=0.1, write_timeout=0.25)
        with Port(served.addresses.pty, line) as port:
            with pytest.raises(WorkError, match=rf"answers at {right} baud, not at 921600: give --baud {right}"):
                loopback(port)
            assert line.baudrate == 921_600
            line.baudrate = right
            assert loopback(port, seconds=0.2).ok


def stranger(length, version, others=()):
    """A device of another protocol: its identity has another length, and it has messages of its own."""
    def answer(data):
        asked = Decoder().feed(data)
        if any(body[0] == MESSAGES["identify"].code for body in asked):
            body = bytes([IDENTITY.code]) + version.to_bytes(2, "little") + (0xABCD).to_bytes(4, "little")
            return encode(body.ljust(length, b"\1"))
        if encode(MESSAGES["query"].pack()) in data:
            return b"".join(encode(bytes([code]) * size) for code, size in others)
        return b""
    return answer


@pytest.mark.parametrize(("length", "others", "words"), [
    (40, (), f"its message identity has 40 bytes, this Station's {IDENTITY.body_size}"),
    (IDENTITY.body_size, ((0x85, 20),), f"its message statistics has 20 bytes, this Station's "
                                        f"{MESSAGES['statistics'].body_size}"),
    (IDENTITY.body_size, ((0x99, 5),), "a message of code 0x99, which this Station does not know"),
    (IDENTITY.body_size, (), "have this Station's lengths: another one, or what their numbers mean, differs"),
])
def test_a_device_of_another_protocol_is_told_with_the_message_that_differs(scripted, length, others, words):
    with pytest.raises(WorkError, match=r"the device speaks protocol 99 \(0000abcd\)") as told:
        loopback(scripted(stranger(length, 99, others)))
    assert words in str(told.value)
    assert "put the matching firmware on the board" in str(told.value) and "\n" not in str(told.value)


class Bursting:
    """A line whose bytes come every 16 ms, as behind an FTDI adapter whose latency timer was left as it is."""

    def __init__(self, line, period=0.016):
        self._line, self._period, self._held, self._next = line, period, b"", 0.0

    def __getattr__(self, name):
        return getattr(self._line, name)

    def read(self, size=1):
        if not self._held:
            now = time.perf_counter()
            self._next = max(self._next + self._period, now)
            time.sleep(self._next - now)
            self._held = self._line.read(max(self._line.in_waiting, 1))
        data, self._held = self._held[:size], self._held[size:]
        return data


def test_a_latency_timer_is_recognised_by_its_bursts_and_told_with_its_setting(monkeypatch, tmp_path):
    (tmp_path / "rig0" / "device").mkdir(parents=True)
    (tmp_path / "rig0" / "device" / "latency_timer").write_text("16\n")
    monkeypatch.setattr(remedies, "_TTY", tmp_path)
    with open_port("sim://sflr?speed=1") as port:
        port.url = "/dev/rig0"
        port.serial = Bursting(port.serial)
        found = loopback(port, seconds=1.0)
    assert not found.ok and found.answered < 0.6
    (words,) = (words for words in found.verdict if "latency timer" in words)
    assert "which stands at 16 ms" in words and "set it to 1 ms" in words and "/dev/rig0" in words


def test_a_port_without_a_latency_timer_has_none(monkeypatch, tmp_path):
    monkeypatch.setattr(remedies, "_TTY", tmp_path)
    assert remedies.latency_timer("/dev/ttyACM0") is None
    assert "stands at" not in remedies.latency_words("/dev/ttyACM0", 0.016)


def test_a_clock_two_percent_off_is_told(rows, tmp_path):
    slow = rows.rig.with_effects([ClockScale(at="clock", ratio=1.02)])
    path = tmp_path / "slow.toml"
    path.write_text(slow.to_toml())
    for _ in range(6):  # a busy machine may fault the device early
        with open_port(f"sim://x?rig={path}&speed=1") as port:
            found = loopback(port, seconds=1.0)
        if found.counts.samples > 300:
            break
    (words,) = (words for words in found.verdict if "clock runs at" in words)
    assert found.pace.ratio == pytest.approx(1.0 / 1.02, abs=1e-3)
    assert "490." in words and "not 500" in words


def test_two_programs_on_one_port_are_told_apart():
    if sys.platform == "win32":
        pytest.skip("no pseudo-terminal here")
    with DeviceProcess("sflr", tcp=False, speed=0) as served, open_port(served.addresses.pty) as port:
        with pytest.raises(WorkError, match="the port is busy; close the other program that holds it"):
            open_port(served.addresses.pty)
        assert loopback(port, seconds=0.2).ok  # the first one is not disturbed
