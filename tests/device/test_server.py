"""The simulated rig in a process of its own: at a pseudo-terminal, at a socket of this machine alone."""

import socket
import sys
import threading

import pytest

from station.device.client import Client
from station.device.framing import encode
from station.device.port import open_port
from station.device.protocol import MESSAGES, PROTOCOL, State
from station.device.server import LOOPBACK, MAX_CONNECTIONS, DeviceProcess, serve
from station.errors import UsageError, WorkError
from station.rig import load_rig

SAMPLE, COMMAND = MESSAGES["sample"], MESSAGES["command"]
PTY = sys.platform != "win32"


@pytest.fixture(scope="module")
def served():
    with DeviceProcess("sflr", pty=PTY, speed=0, seed=1) as device:
        yield device.addresses


def exchange(url, ticks=50):
    with open_port(url) as port:
        client = Client(port)
        identity = client.identify()
        if identity.state == State.FAULT:
            client.clear()
            client.identify()
        client.configure(500.0, 200)
        client.arm()
        client.start()
        got = []
        while len(got) < ticks:
            bodies = list(client.inbox) or client.decoder.feed(port.read(SAMPLE.wire_size))
            client.inbox.clear()
            for body in bodies:
                sample = SAMPLE.unpack(body)
                got.append(sample)
                port.write(encode(COMMAND.pack(index=sample.index + 1, command=sample.index % 50), client.session))
        client.halt()
        return identity, got


@pytest.mark.parametrize("line", ["tcp", pytest.param("pty", marks=pytest.mark.skipif(not PTY, reason="no pty here"))])
def test_the_same_device_answers_on_either_line(served, line):
    url = getattr(served, line)
    for _ in range(2):  # hosts come and go
        identity, got = exchange(url)
        assert identity.board == "sflr"
        assert [sample.index for sample in got] == list(range(50))
        assert [sample.command for sample in got] == [0] + [i % 50 for i in range(49)]


@pytest.mark.skipif(not PTY, reason="no pty here")
def test_it_is_one_device(served):
    zero_ids = []
    for url in (served.pty, served.tcp, served.pty):
        zero_ids.append(exchange(url, 5)[0].zero_id)
    assert len(set(zero_ids)) == 1


def test_who_speaks_while_a_run_is_on_is_not_heard(served):
    with open_port(served.tcp) as port:
        client = Client(port)
        client.identify()
        client.configure(500.0, 200)
        client.arm()
        client.start()
        with socket.create_connection((LOOPBACK, int(served.tcp.rsplit(":", 1)[1]))) as other:
            other.sendall(encode(MESSAGES["stop"].pack()) * 3)
            indices = []
            bodies = list(client.inbox)
            while len(indices) < 100:
                for body in bodies:
                    indices.append(SAMPLE.unpack(body).index)
                    port.write(encode(COMMAND.pack(index=indices[-1] + 1, command=1), client.session))
                bodies = client.decoder.feed(port.read(SAMPLE.wire_size))
            assert indices == list(range(len(indices)))
            client.halt()
            assert client.statistics().samples >= 100
            assert client.statistics().corrupt == 0


def test_half_a_frame_of_one_host_does_not_spoil_the_next_ones(served):
    with socket.create_connection((LOOPBACK, int(served.tcp.rsplit(":", 1)[1]))) as other:
        other.sendall(b"\x05\x05\x05")
    assert exchange(served.tcp, 5)[0].board == "sflr"


def test_it_listens_on_this_machine_alone(served):
    host, port = served.tcp.removeprefix("socket://").split(":")
    assert host == "127.0.0.1"
    mine = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {"127.0.0.1"}
    for address in mine:
        with pytest.raises(OSError):
            socket.create_connection((address, int(port)), timeout=1.0).close()


def test_a_taken_port_is_told_in_one_line():
    with socket.create_server((LOOPBACK, 0)) as taken:
        number = taken.getsockname()[1]
        with pytest.raises(WorkError, match=f"127.0.0.1:{number}: cannot listen"):
            serve(load_rig("sflr"), pty=False, tcp_port=number)


def test_a_device_at_no_address_is_refused():
    with pytest.raises(UsageError, match="neither"):
        serve(load_rig("sflr"), pty=False, tcp_port=None)


def test_a_platform_without_pseudo_terminals_is_told_so(monkeypatch):
    monkeypatch.delattr("os.ttyname", raising=False)
    with pytest.raises(UsageError, match="this platform has none"):
        serve(load_rig("sflr"), pty=True)


def test_serve_ends_when_it_is_told_to():
    stop, found = threading.Event(), []
    ready = threading.Event()

    def tell(addresses):
        found.append(addresses)
        ready.set()

    thread = threading.Thread(target=serve, args=(load_rig("sflr"), False, 0),
                              kwargs={"speed": 1, "ready_callback": tell, "stop": stop})
    thread.start()
    assert ready.wait(30)
    with open_port(found[0].tcp) as port:
        port.write(encode(MESSAGES["identify"].pack(version=PROTOCOL.version, hash=PROTOCOL.hash, nonce=0)))
        assert len(port.read(MESSAGES["identity"].wire_size)) == MESSAGES["identity"].wire_size
    stop.set()
    thread.join(5.0)
    assert not thread.is_alive()


def test_an_unknown_rig_is_a_failure_to_start(capfd):
    with pytest.raises(WorkError, match="did not start"), DeviceProcess("no-such-rig"):
        pass
    assert "no-such-rig" in capfd.readouterr().err


def test_idle_connections_end_nothing_and_the_next_host_is_served(served):
    """Hosts that say nothing, garbage, an HTTP request."""
    port = int(served.tcp.rsplit(":", 1)[1])
    idle = []
    try:
        for _ in range(200):
            idle.append(socket.create_connection((LOOPBACK, port), timeout=5.0))
            if len(idle) > 50:
                idle.pop(0).close()
        for said in (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", bytes(range(256)) * 64):
            with socket.create_connection((LOOPBACK, port), timeout=5.0) as stranger:
                stranger.sendall(said)
        identity, got = exchange(served.tcp)
        assert identity.board == "sflr" and len(got) == 50
    finally:
        for each in idle:
            each.close()


def test_many_idle_connections_at_once_are_capped(served):
    import psutil

    port = int(served.tcp.rsplit(":", 1)[1])
    idle = [socket.create_connection((LOOPBACK, port), timeout=5.0) for _ in range(200)]
    try:
        exchange(served.tcp)
        there = [c for c in psutil.Process().children(recursive=True)
                 for c in c.net_connections("tcp") if c.laddr.port == port and c.status == "ESTABLISHED"]
        assert 1 <= len(there) <= MAX_CONNECTIONS + 1
    finally:
        for each in idle:
            each.close()
