"""What a line carries: the highest rate at which a sample's command comes back in time."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from serial.tools.list_ports import comports

from station.device.client import Identity
from station.device.port import Port
from station.device.protocol import LIMITS, MESSAGES
from station.errors import UsageError

USB_ALLOWANCE = 2000
"""Microseconds of each answer for host and USB: a frame of 1 ms each way."""
MOST_ANSWER_TICKS = LIMITS["answer_ticks_max"]
_SLACK = 1e-6
"""Hz by which a rate may be above the highest for its rounding alone."""


def _microseconds(name: str, baud_rate: int) -> int:
    """What a message takes on the line, rounded up as the device does; 0 where the line has no baud rate."""
    bits = MESSAGES[name].wire_size * LIMITS["line_bits_per_byte"]
    return math.ceil(bits * 1_000_000 / baud_rate) if baud_rate else 0


@dataclass(frozen=True)
class Line:
    """A line between host and device: its baud rate (0: none), and the allowance of each answer, microseconds."""

    baud_rate: int
    allowance: int

    @classmethod
    def of(cls, port: Port, identity: Identity) -> Line:
        """The line as the device knows it, with the adapter that only this host can see."""
        own = round(1e6 * identity.allowance)
        return cls(identity.baud_rate, max(own, USB_ALLOWANCE) if is_usb(port.url) else own)

    def highest_rate(self, answer_ticks: int) -> float:
        """Hz; inf where nothing limits it.

        Sample, command and allowance take at most ``answer_ticks`` periods, and each frame one, in whole microseconds
        as the device works them out (``carries`` in firmware/core/core.c).
        """
        frames = _microseconds("sample", self.baud_rate), _microseconds("command", self.baud_rate)
        period = max(*frames, math.ceil((sum(frames) + self.allowance) / answer_ticks))
        return 1e6 / period if period else math.inf

    def least_answer_ticks(self, rate: float) -> int | None:
        """The least that holds a rate (Hz); None where none does."""
        return next((ticks for ticks in range(1, MOST_ANSWER_TICKS + 1)
                     if rate <= self.highest_rate(ticks) + _SLACK), None)

    def require(self, url: str, rate: float, answer_ticks: int) -> None:
        """UsageError, with the highest rate, where the line cannot answer at ``rate`` (Hz) in time."""
        if not 1 <= answer_ticks <= MOST_ANSWER_TICKS:
            raise UsageError(f"answer_ticks: from 1 to {MOST_ANSWER_TICKS}, not {answer_ticks}")
        highest = self.highest_rate(answer_ticks)
        if rate <= highest + _SLACK:
            return
        least = self.least_answer_ticks(rate)
        more = f"; answer_ticks = {least} would carry it" if least else ""
        line = f"{self.baud_rate} baud" if self.baud_rate else "USB"
        raise UsageError(f"{url}: this line ({line}, {self.allowance / 1000:g} ms of each answer for host and adapter) "
                         f"carries {math.floor(highest)} Hz at most with answer_ticks = {answer_ticks}, not {rate:g}; "
                         f"take a lower sample_rate or a higher baud rate{more}")


def is_usb(path: str) -> bool:
    """Whether the port is a serial line over USB: an adapter's, or the chip's own.  False for what no system lists."""
    names = {path, path.replace("/dev/tty.", "/dev/cu.", 1)}  # macOS: two names of one port, the second is listed
    if os.path.islink(path):
        names.add(os.path.realpath(path))
    wanted = {os.path.normcase(name) for name in names}
    return any(found.vid is not None and os.path.normcase(found.device) in wanted for found in comports())
