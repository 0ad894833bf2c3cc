"""Opening a port by pyserial: a path, or any pyserial URL (sim:// and replay:// among them), with errors for people."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from urllib.parse import urlsplit

import serial
from serial.serialutil import SerialBase, SerialException
from serial.tools.list_ports import comports

from station.errors import StationError, UsageError, WorkError

HANDLERS = "station.device.urls"
BAUD_RATE = 921_600
"""For a board behind a UART; USB and sockets take no notice."""
TIMEOUT = 0.1
"""Seconds for which a read waits: short, so that Ctrl-C is heard on every platform."""
WRITE_TIMEOUT = 0.25


class Port:
    """An open port.  ``read`` and ``write`` raise WorkError, naming the port, when the line is lost."""

    _wakes_at = 1

    def __init__(self, url: str, line: SerialBase) -> None:
        self.url = url
        self.serial = line
        self._send = _sender(line)

    def read(self, size: int) -> bytes:
        """Up to size bytes; fewer where TIMEOUT passes first."""
        try:
            self.wake_at(size)
            data = self.serial.read(size)
            if not data and self._wakes_at > 1:
                self.wake_at(1)
                if self.serial.in_waiting:
                    data = self.serial._socket.recv(size)
            return data
        except (SerialException, OSError, TypeError) as error:  # TypeError: pyserial's, on a port closed meanwhile
            raise self._lost(error) from None

    def write(self, data: bytes) -> None:
        """Send all bytes, at once."""
        try:
            if self._send is not None:
                try:
                    data = data[self._send(data):]
                except BlockingIOError:
                    pass
                if not data:
                    return
            self.serial.write(data)
        except (SerialException, OSError, TypeError) as error:
            raise self._lost(error) from None

    @property
    def descriptor(self) -> int | None:
        """The system's number of a plain serial port or socket, for a loop in C; None for others, and on Windows."""
        if os.name != "posix" or self._send is None:
            return None
        connection = getattr(self.serial, "_socket", None)
        return self.serial.fd if connection is None else connection.fileno()

    @property
    def is_terminal(self) -> bool:
        """Whether the system treats the line as a terminal: a serial port or a pseudo-terminal."""
        return self.descriptor is not None and os.isatty(self.descriptor)

    def read_waiting(self) -> bytes:
        """What has come, at least one byte; b"" where nothing comes for TIMEOUT."""
        try:
            self.wake_at(1)
            return self.serial.read(max(1, self.serial.in_waiting))
        except (SerialException, OSError, TypeError) as error:
            raise self._lost(error) from None

    def wake_at(self, count: int) -> None:
        """Let a socket wake its reader for so many bytes, not for each of a frame that comes in pieces."""
        connection = getattr(self.serial, "_socket", None)
        if count != self._wakes_at and isinstance(connection, socket.socket):
            self._wakes_at = count
            with contextlib.suppress(OSError):  # Windows knows no such thing
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, count)

    def _lost(self, error: Exception) -> WorkError:
        return WorkError(f"{self.url}: the line was lost ({_words(error)}); check cable and device")

    def close(self) -> None:
        """Close it; a line already lost is no error here."""
        self._send = None
        with contextlib.suppress(SerialException, OSError):
            self.serial.close()

    def __enter__(self) -> Port:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


def _sender(line: SerialBase) -> Callable[[bytes], int] | None:
    """The system's own call that sends at once what finds room, for pyserial's plain ports; None for others.

    pyserial asks after each write whether the next one would find room: two system calls for one.
    """
    if os.name == "posix" and type(line) is serial.Serial:
        return partial(os.write, line.fd)
    connection = getattr(line, "_socket", None)
    return connection.send if isinstance(connection, socket.socket) else None


def _words(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _lacks_port_number(url: str) -> bool:
    try:
        return url.lower().startswith(("socket://", "rfc2217://")) and urlsplit(url).port is None
    except ValueError:  # what stands there is no number, or too large
        return True


def _complaint(url: str, error: Exception) -> StationError:
    """What pyserial or the system said, as one line with what to do."""
    if _lacks_port_number(url):
        return UsageError(f"{url}: a port number from 0 to 65535 is missing; write {url.partition(':')[0]}://HOST:PORT")
    text = _words(error)
    code = getattr(error, "errno", None)
    if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV) or "FileNotFoundError" in text:
        return UsageError(f"{url}: no such port; `station ports` lists those there are")
    if "exclusively lock" in text or code == errno.EBUSY or "in use" in text:
        return WorkError(f"{url}: the port is busy; close the other program that holds it")
    if code in (errno.EACCES, errno.EPERM):
        return WorkError(f"{url}: no permission; on Linux join the port's group "
                         "(`sudo usermod -a -G dialout $USER`) and log in again")
    if "PermissionError" in text:  # Windows says the same of a port that another program holds
        return WorkError(f"{url}: access denied; close the other program that holds the port")
    if "Connection refused" in text or "timed out" in text or "getaddrinfo" in text:
        return WorkError(f"{url}: nobody listens there; start `station device` or check address and port number")
    if "Could not configure port" in text or code in (errno.ENOTTY, errno.EISDIR):
        return UsageError(f"{url}: not a serial port")
    return WorkError(f"{url}: cannot be opened ({text})")


def open_port(url: str, baud_rate: int | None = None) -> Port:
    """Open a path or a pyserial URL.  UsageError: no such port, bad URL; WorkError: busy, no permission, refused."""
    baud_rate = BAUD_RATE if baud_rate is None else baud_rate
    if HANDLERS not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(HANDLERS)
    try:
        line = serial.serial_for_url(url, baudrate=baud_rate, timeout=TIMEOUT, write_timeout=WRITE_TIMEOUT,
                                     exclusive=True)
    except SerialException as error:
        if isinstance(error.__cause__, StationError):
            raise error.__cause__ from None
        raise _complaint(url, error) from None
    except ValueError as error:
        raise UsageError(f"{url}: not a port ({_words(error)}); "
                         "a path, or sim://RIG, replay://RUN, socket://HOST:PORT") from None
    except (OSError, AttributeError, TypeError) as error:  # the last two: pyserial's, on malformed URLs
        raise _complaint(url, error) from None
    _send_at_once(line)
    return Port(url, line)


def _send_at_once(line: SerialBase) -> None:
    """Switch off the delay of small packets (Nagle's) on a socket, which pyserial leaves on: 40 ms now and then."""
    connection = getattr(line, "_socket", None)
    if isinstance(connection, socket.socket) and connection.family in (socket.AF_INET, socket.AF_INET6):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


@dataclass(frozen=True)
class PortInfo:
    """A serial port of this machine: its path and what the system says about it."""

    path: str
    description: str
    hardware: str


def list_ports() -> list[PortInfo]:
    """The machine's serial ports, by path."""
    return [PortInfo(found.device, found.description or "", found.hwid or "")
            for found in sorted(comports(), key=lambda found: found.device)]
