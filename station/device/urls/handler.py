"""What the URL handlers share: pyserial's port class on a device in this process, and the parsing of URLs."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar
from urllib.parse import parse_qsl, unquote

from serial.serialutil import PortNotOpenError, SerialBase, SerialException

from station.device.faults import Faults
from station.device.pacing import LockstepLine, PacedLine, line_of
from station.device.simulated import Options, SimulatedDevice
from station.errors import StationError, UsageError

_NUMBERS: dict[str, tuple[type, float, float]] = {
    "speed": (int, 0, 1), "seed": (int, 0, 2**63), "noise": (float, 0.0, 1e4), "angle": (float, -1e3, 1e3),
    "accel_offset": (float, -1e4, 1e4), "drop": (float, 0.0, 1.0), "flip": (float, 0.0, 1.0),
    "duplicate": (float, 0.0, 1.0), "late": (float, 0.0, 1.0), "reorder": (float, 0.0, 1.0),
    "silent_after": (int, 0, 2**31), "unplug_after": (int, 0, 2**31),
}
_OF_FAULTS = frozenset(Faults.__dataclass_fields__)


def parse_url(url: str, scheme: str, others: frozenset[str] = frozenset()) -> tuple[str, dict[str, str], Options]:
    """Split scheme://NAME?key=value&...; returns the name, the keys in ``others``, and the options.

    UsageError names the key that is unknown or out of range.
    """
    name, _, query = url[len(scheme) + 3:].partition("?")
    rest: dict[str, str] = {}
    options: dict[str, object] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key in others:
            rest[key] = text
        elif key == "on" and text in ("sample", "command"):
            options[key] = (text,)
        elif key in _NUMBERS:
            kind, low, high = _NUMBERS[key]
            try:
                value = kind(text)
            except ValueError:
                value = None
            if value is None or not low <= value <= high:
                raise UsageError(f"{url}: {key}={text}: a number from {low:g} to {high:g} is wanted")
            options[key] = value
        else:
            choices = sorted([*others, *_NUMBERS, "on"])
            raise UsageError(f"{url}: {key}={text}: unknown; choose from {', '.join(choices)}")
    faults = Faults(**{key: options.pop(key) for key in list(options) if key in _OF_FAULTS})
    return unquote(name), rest, Options(faults=faults, **options)


class DeviceSerial(SerialBase):
    """A pyserial port whose device lives in this process.  Baud rate and the like are taken and ignored."""

    BAUDRATES: ClassVar = SerialBase.BAUDRATES
    make_device: Callable[[str], SimulatedDevice]
    _line: LockstepLine | PacedLine | None = None

    def open(self) -> None:
        """Build the device and start its line; SerialException where that fails."""
        if self._port is None:
            raise SerialException("Port must be configured before it can be used.")
        if self.is_open:
            raise SerialException("Port is already open.")
        try:
            device = type(self).make_device(self.portstr)
        except StationError as error:
            raise SerialException(str(error)) from error
        self._line = line_of(device)
        self.is_open = True

    def close(self) -> None:
        """End the line; a device that was running is gone with it."""
        if self.is_open:
            self.is_open = False
            self._line.close()

    @property
    def device(self) -> SimulatedDevice:
        """The device behind this port, for tests."""
        return self._open_line().device

    def _open_line(self) -> LockstepLine | PacedLine:
        if not self.is_open:
            raise PortNotOpenError()
        if self._line.device.unplugged:
            raise SerialException(f"{self.portstr}: device disconnected")
        return self._line

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        return self._open_line().waiting()

    def read(self, size: int = 1) -> bytes:
        """Up to size bytes; fewer where the timeout passes."""
        line = self._open_line()
        data = line.read(size, self._timeout)
        if not data and line.device.unplugged:
            raise SerialException(f"{self.portstr}: device disconnected")
        return data

    def write(self, data: bytes) -> int:
        """Send bytes to the device."""
        data = bytes(data)
        self._open_line().write(data)
        return len(data)

    def flush(self) -> None:
        """Nothing waits to be sent."""
        self._open_line()

    def reset_input_buffer(self) -> None:
        """Forget what was not read."""
        self._open_line().clear()

    def reset_output_buffer(self) -> None:
        """Nothing waits to be sent."""
        self._open_line()

    def _reconfigure_port(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    cts = dsr = cd = property(lambda self: self._open_line() is not None)
    ri = property(lambda self: self._open_line() is None)
