"""The simulated rig for any serial program: at a pseudo-terminal's path and at a TCP port of 127.0.0.1.

Run in a process of its own; ``python -m station.device.server --rig sflr --tcp 0`` is what ``DeviceProcess`` starts.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from station.device.emulator import Emulator
from station.device.faults import Faults
from station.device.pacing import run_device
from station.device.simulated import Options, SimulatedDevice
from station.errors import StationError, UsageError, WorkError
from station.rig import Rig, load_rig

LOOPBACK = "127.0.0.1"
_CHUNK = 4096
MAX_CONNECTIONS = 16
"""Hosts that may be connected at once; for one more the oldest that does not run a session is dropped."""


class _PseudoTerminal:
    """The device's end of a pseudo-terminal.  Both ends stay open, so that hosts may come and go."""

    def __init__(self) -> None:
        import pty  # not on Windows
        import tty

        self._device, self._host = pty.openpty()
        tty.setraw(self._host)
        os.set_blocking(self._device, False)
        self.path = os.ttyname(self._host)

    def fileno(self) -> int:
        return self._device

    def read(self) -> bytes | None:
        """Bytes from the host."""
        try:
            return os.read(self._device, _CHUNK)
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        """Bytes to the host; what finds no room is lost, as on a wire that nobody reads."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._device, data)

    def close(self) -> None:
        os.close(self._device)
        os.close(self._host)


class _Connection:
    """The device's end of a TCP connection."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        self._socket = connection

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes | None:
        """Bytes from the host; None when it has gone."""
        try:
            return self._socket.recv(_CHUNK) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None

    def write(self, data: bytes) -> None:
        """Bytes to the host; what finds no room is lost."""
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def close(self) -> None:
        self._socket.close()


class _Exchange:
    """The line of the device: one host at a time, the last that spoke while the device was not running."""

    def __init__(self, device: SimulatedDevice, pty: bool, tcp_port: int | None) -> None:
        self._device = device
        self._terminal = _PseudoTerminal() if pty else None
        self._listener: socket.socket | None = None
        self._ends = selectors.SelectSelector()  # the others wait whole milliseconds: a tick would be late
        self._connections: list[_Connection] = []
        if self._terminal:
            self._ends.register(self._terminal, selectors.EVENT_READ)
        self._active: _PseudoTerminal | _Connection | None = None
        if tcp_port is not None:
            self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            if sys.platform != "win32":  # there it would let two programs share the port
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                self._listener.bind((LOOPBACK, tcp_port))
            except OSError as error:
                self.close()
                raise WorkError(f"{LOOPBACK}:{tcp_port}: cannot listen ({error.strerror}); "
                                "choose another port") from None
            self._listener.listen(64)
            self._listener.setblocking(False)
            self._ends.register(self._listener, selectors.EVENT_READ)

    @property
    def path(self) -> str | None:
        """The pseudo-terminal's path."""
        return self._terminal.path if self._terminal else None

    @property
    def port(self) -> int | None:
        """The TCP port."""
        return self._listener.getsockname()[1] if self._listener else None

    @property
    def connected(self) -> bool:
        """Whether the active host has not hung up (a pseudo-terminal never tells)."""
        return self._active is not None

    def receive(self, timeout: float) -> bytes:
        """Bytes from the active host; b"" where none came within timeout seconds."""
        data = b""
        for ready, _ in self._ends.select(timeout):
            end: Any = ready.fileobj
            if end is self._listener:
                self._accept()
                continue
            if end is not self._terminal and end not in self._connections:  # dropped to make room
                continue
            got = end.read()
            if got is None:
                self._drop(end)
            elif end is self._active:
                data += got
            elif got and not self._device.core.running:
                self._active = end
                data += b"\0" + got  # whatever the other host left unfinished ends here
        return data

    def send(self, data: bytes) -> None:
        """Bytes to the active host."""
        if self._active is not None:
            self._active.write(data)

    def _accept(self) -> None:
        """Take the hosts that wait; where there are MAX_CONNECTIONS the oldest idle one makes room."""
        for _ in range(MAX_CONNECTIONS):
            try:
                end = _Connection(self._listener.accept()[0])
            except OSError:
                return
            self._ends.register(end, selectors.EVENT_READ)
            self._connections.append(end)
            if len(self._connections) > MAX_CONNECTIONS:
                self._drop(next(idle for idle in self._connections if idle is not self._active))

    def _drop(self, end: _Connection) -> None:
        self._ends.unregister(end)
        self._connections.remove(end)
        end.close()
        if end is self._active:
            self._active = None

    def close(self) -> None:
        for key in list(self._ends.get_map().values()):
            end: Any = key.fileobj
            end.close()
        if self._listener is not None:
            self._listener.close()
        self._ends.close()


@dataclass(frozen=True)
class Addresses:
    """Where hosts find the device, as URLs for ``open_port`` (None: not offered)."""

    pty: str | None
    tcp: str | None


def serve(rig: Rig, pty: bool = True, tcp_port: int | None = None, speed: int = 1, seed: int | None = None,
          ready_callback: Callable[[Addresses], None] | None = None, *, options: Options | None = None,
          stop: threading.Event | None = None, board: str = "host") -> None:
    """Serve the simulated rig until ``stop`` is set or an exception (Ctrl-C) comes.

    tcp_port: 0 for any free one, None for none.  ``options`` takes the place of speed and seed.
    ``ready_callback`` is told the addresses once the device answers.  ``board``: ``host``, or the name of one that is
    emulated, which offers one address alone.  UsageError where a pseudo-terminal is wanted and the platform has none,
    WorkError where the port is taken.
    """
    if pty and not hasattr(os, "ttyname"):
        raise UsageError("pseudo-terminal: this platform has none; use a TCP port")
    if not pty and tcp_port is None:
        raise UsageError("device: neither a pseudo-terminal nor a TCP port was asked for")
    options = options or Options(speed=speed, seed=seed)
    if board != "host":
        _serve_emulated(board, rig, options, pty, tcp_port, ready_callback, stop or threading.Event())
        return
    device = SimulatedDevice.of_rig(rig, options)
    exchange = _Exchange(device, pty, tcp_port)
    try:
        if ready_callback is not None:
            ready_callback(Addresses(exchange.path,
                                     f"socket://{LOOPBACK}:{exchange.port}" if tcp_port is not None else None))
        run_device(device, exchange, stop or threading.Event())
    finally:
        exchange.close()


def _serve_emulated(board: str, rig: Rig, options: Options, pty: bool, tcp_port: int | None,
                    ready_callback: Callable[[Addresses], None] | None, stop: threading.Event) -> None:
    if pty and tcp_port is not None:
        raise UsageError(f"{board}: it has one line; ask for a pseudo-terminal or for a TCP port")
    with Emulator(rig, options, board, tcp_port or 0, pty) as emulator:
        if ready_callback is not None:
            ready_callback(Addresses(*((emulator.url, None) if pty else (None, emulator.url))))
        while not stop.wait(0.2):
            if not emulator.thread.is_alive():
                raise WorkError(f"{board}: the emulator has ended")


class DeviceProcess:
    """``serve`` in a process of its own, for as long as the context lasts; ``addresses`` say where."""

    def __init__(self, rig: str, pty: bool = True, tcp: bool = True, speed: int = 1, seed: int | None = None,
                 noise: float = 0.0, board: str = "host", options: Sequence[str] = ()) -> None:
        self._arguments = [sys.executable, "-m", "station.device.server", "--rig", str(rig), "--speed", str(speed),
                           "--noise", str(noise), "--board", board, *options, *(["--pty"] if pty else []),
                           *(["--tcp", "0"] if tcp else []),
                           *([] if seed is None else ["--seed", str(seed)])]
        self.addresses = Addresses(None, None)
        self.process: subprocess.Popen[str] | None = None

    def __enter__(self) -> DeviceProcess:
        self.process = subprocess.Popen(self._arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        line = self.process.stdout.readline().split()
        if len(line) != 2:
            self.process.wait()
            raise WorkError("device: the simulated rig's process did not start")
        self.addresses = Addresses(*(None if word == "-" else word for word in line))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.process.stdin.close()  # the process ends with its parent, whatever becomes of that
        try:
            self.process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.process.stdout.close()


def main() -> int:
    """Serve until the parent closes standard input; write the two addresses on one line."""
    parser = argparse.ArgumentParser(prog="station.device.server")
    parser.add_argument("--rig", required=True)
    parser.add_argument("--pty", action="store_true")
    parser.add_argument("--tcp", type=int)
    parser.add_argument("--speed", type=int, choices=(0, 1), default=1)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--angle", type=float, default=0.0)
    parser.add_argument("--accel-offset", type=float, default=0.0)
    parser.add_argument("--board", default="host")
    wanted = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; the device stays to take its stop
    stop = threading.Event()

    def watch_parent() -> None:
        sys.stdin.read()
        stop.set()
        time.sleep(2.0)
        os._exit(0)

    threading.Thread(target=watch_parent, daemon=True).start()
    try:
        serve(load_rig(wanted.rig), wanted.pty, wanted.tcp, stop=stop,
              options=Options(wanted.speed, wanted.seed, wanted.noise, wanted.angle, wanted.accel_offset, Faults()),
              board=wanted.board,
              ready_callback=lambda found: print(found.pty or "-", found.tcp or "-", flush=True))
    except StationError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
