"""Opening ports and speaking with what is there: every failure is one line that names the port."""

import os
import socket
import sys

import pytest
import serial
from serial.serialutil import SerialException

from station.device.client import Client
from station.device.framing import Decoder, encode
from station.device.port import list_ports, open_port
from station.device.protocol import MESSAGES, PROTOCOL
from station.errors import StationError, UsageError, WorkError

posix = pytest.mark.skipif(sys.platform == "win32", reason="paths of POSIX")


def complaint(url):
    with pytest.raises(StationError) as told:
        open_port(url).close()
    assert "\n" not in str(told.value)
    return told.value


@posix
@pytest.mark.parametrize(("url", "status", "words"), [
    ("/dev/no-such-port", 2, "no such port"),
    ("/etc/passwd", 2, "not a serial port"),
    ("/tmp", 2, "not a serial port"),
    ("nonsense://x", 2, "not a port"),
    ("sim://", 2, "which rig"),
    ("sim://no-such-rig", 2, "no-such-rig"),
    ("sim://sflr?nonsense=1", 2, "nonsense=1: unknown"),
    ("sim://sflr?noise=-1", 2, "noise=-1: a number from 0"),
    ("sim://sflr?speed=2", 2, "speed=2"),
    ("sim://sflr?drop=1.5", 2, "drop=1.5"),
    ("replay://", 2, "which run"),
    ("replay://no-such-run.mcap", 1, "no-such-run.mcap"),
    ("socket://127.0.0.1:1", 1, "nobody listens"),
    ("socket://", 2, "a port number from 0 to 65535 is missing; write socket://HOST:PORT"),
    ("socket://127.0.0.1", 2, "a port number"), ("socket://127.0.0.1:99999", 2, "a port number"),
    ("socket://127.0.0.1:x", 2, "a port number"), ("rfc2217://127.0.0.1", 2, "write rfc2217://HOST:PORT"),
])
def test_what_cannot_be_opened_is_told_in_one_line(url, status, words):
    error = complaint(url)
    assert error.exit_status == status
    assert words in str(error)


@posix
def test_a_port_that_another_program_holds_is_busy():
    import pty

    _, slave = pty.openpty()
    path = os.ttyname(slave)
    with open_port(path):
        error = complaint(path)
    assert isinstance(error, WorkError)
    assert "busy" in str(error)


@pytest.mark.parametrize(("error", "kind", "words"), [
    (SerialException(13, "could not open port X: [Errno 13] Permission denied: 'X'"), WorkError, "no permission"),
    (SerialException("could not open port 'COM9': FileNotFoundError(2, 'not found', None, 2)"), UsageError, "no such"),
    (SerialException("could not open port 'COM3': PermissionError(13, 'Access is denied.', None, 5)"), WorkError,
     "access denied"),
    (SerialException(16, "Device or resource busy"), WorkError, "busy"),
])
def test_what_the_systems_say_is_understood(monkeypatch, error, kind, words):
    def refuse(*args, **kwargs):
        raise error
    monkeypatch.setattr(serial, "serial_for_url", refuse)
    told = complaint("X")
    assert type(told) is kind
    assert words in str(told)


def test_a_silent_port_is_no_station_device(scripted):
    with pytest.raises(WorkError, match="scripted: no Station device answers"):
        Client(scripted(lambda data: b"")).identify()


def test_a_port_with_something_else_behind_it_is_no_station_device(scripted):
    with pytest.raises(WorkError, match=r"not a Station device \(\d+ bytes came"):
        Client(scripted(lambda data: b"ERROR: unknown command\r\n")).identify()
    with pytest.raises(WorkError, match="not a Station device"):
        Client(scripted(lambda data: data)).identify()  # an echo


@pytest.mark.parametrize("extra", [b"", b"\1\2\3\4", b"\0" * 20])
def test_a_device_of_another_protocol_version_is_refused_in_one_line(scripted, extra):
    head = bytes([MESSAGES["identity"].code]) + (PROTOCOL.version + 1).to_bytes(2, "little") + b"\x11\x22\x33\x44"
    with pytest.raises(WorkError) as told:
        Client(scripted(lambda data: encode(head + extra))).identify()
    assert "\n" not in str(told.value)
    assert f"speaks protocol {PROTOCOL.version + 1} (44332211), this Station {PROTOCOL.version} " in str(told.value)


def test_a_device_of_the_same_version_and_other_fields_is_refused(scripted):
    values = {field.name: b"" if field.text_size else 0 for field in MESSAGES["identity"].fields}
    body = MESSAGES["identity"].pack(**values | {"version": PROTOCOL.version, "hash": PROTOCOL.hash ^ 1})
    with pytest.raises(WorkError, match="put the matching firmware"):
        Client(scripted(lambda data: encode(body))).identify()


def test_a_line_lost_while_asking_names_the_port(scripted):
    port = scripted(lambda data: b"")
    port.serial.gone = True
    with pytest.raises(WorkError, match="scripted: the line was lost .* check cable"):
        Client(port).identify()


def test_a_socket_that_closes_is_a_lost_line():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(f"socket://127.0.0.1:{server.getsockname()[1]}")
        server.accept()[0].close()
        with port, pytest.raises(WorkError, match="the line was lost"):
            Client(port).identify()


def test_refusals_are_told_in_words():
    with open_port("sim://sflr") as port:
        client = Client(port)
        client.identify()
        with pytest.raises(WorkError, match="refuses arm: it is not configured"):
            client.arm()
        with pytest.raises(WorkError, match="refuses configure: a value is beyond"):
            client.configure(500.0, 201)
        with pytest.raises(WorkError, match="refuses start: it is idle"):
            client._ask("start", session=1, challenge=0)
        with pytest.raises(WorkError, match="refuses zero: the arm is moving"):
            client.zero()


def test_ports_are_listed_by_path():
    paths = [found.path for found in list_ports()]
    assert paths == sorted(paths)


def identity_for(data, challenge, nonce=None):
    """The answer to the identify in these bytes."""
    (body,) = Decoder().feed(data)
    values = {field.name: b"" if field.text_size else 0 for field in MESSAGES["identity"].fields}
    values |= {"version": PROTOCOL.version, "hash": PROTOCOL.hash, "challenge": challenge,
               "nonce": MESSAGES["identify"].unpack(body).nonce if nonce is None else nonce}
    return encode(MESSAGES["identity"].pack(**values))


def test_what_an_earlier_connection_left_on_the_line_is_not_taken_for_an_answer(scripted):
    stale = (encode(MESSAGES["fault"].pack(fault=1, index=3))
             + encode(MESSAGES["reply"].pack(request=MESSAGES["stop"].code, result=0, state=0, fault=0, status=0,
                                             encoder=0)))

    def answer(data):
        nonce = MESSAGES["identify"].unpack(Decoder().feed(data)[0]).nonce
        return stale + identity_for(data, 8, nonce ^ 1) + identity_for(data, 9)

    client = Client(scripted(answer))
    client.identify()
    assert not client.inbox
    assert client._challenge == 9


def test_of_several_identities_the_last_ones_challenge_counts(scripted):
    """A board that was not ready answers every identify that was sent meanwhile."""
    asked = []

    def answer(data):
        asked.append(data)
        return b"" if len(asked) < 3 else b"".join(identity_for(each, n + 1) for n, each in enumerate(asked))

    client = Client(scripted(answer))
    client.identify()
    assert client._challenge == 3


def test_a_stop_that_is_not_answered_is_sent_again(scripted):
    answers = iter([b"", b"", encode(MESSAGES["reply"].pack(request=MESSAGES["stop"].code, result=0, state=0, fault=0,
                                                            status=0, encoder=0))])
    port = scripted(lambda data: next(answers))
    assert Client(port).halt()
    assert port.serial.written == encode(MESSAGES["stop"].pack()) * 3


def test_a_stop_on_a_lost_line_is_no_error(scripted):
    port = scripted(lambda data: b"")
    assert not Client(port).halt()
    port.serial.gone = True
    assert not Client(port).halt()


def test_an_emulator_that_is_missing_is_told_with_what_to_install(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    error = complaint("qemu://sflr")
    assert isinstance(error, UsageError) and "apt install qemu-system-arm" in str(error)
    assert "which rig" in str(complaint("qemu://"))


def test_what_came_of_a_frame_before_the_timeout_is_read_at_once():
    with socket.create_server(("127.0.0.1", 0)) as server, open_port(
            f"socket://127.0.0.1:{server.getsockname()[1]}") as port, server.accept()[0] as other:
        other.sendall(b"123456789")
        assert port.read(22) == b"123456789"
        other.sendall(b"ab")
        assert port.read_waiting() == b"a"
        assert port.read(1) == b"b"


@posix
def test_a_pseudo_terminal_is_a_terminal_and_a_socket_is_none():
    ours, theirs = os.openpty()
    try:
        with open_port(os.ttyname(theirs)) as port:
            assert port.is_terminal
    finally:
        os.close(ours)
        os.close(theirs)
    with socket.create_server(("127.0.0.1", 0)) as server, \
            open_port(f"socket://127.0.0.1:{server.getsockname()[1]}") as port:
        assert not port.is_terminal
