"""Why a line does not carry a test, and what a person does about it: what `station loopback` looks for."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import serial

from station.device.client import ANSWER_SECONDS, Client
from station.device.framing import any_body, encode
from station.device.port import Port
from station.device.protocol import MESSAGE_OF_CODE, MESSAGES, PROTOCOL
from station.errors import WorkError

BAUD_RATES = (921_600, 115_200, 460_800, 230_400, 500_000, 1_000_000, 2_000_000, 57_600, 38_400, 9_600)
"""What devices are set to, the likeliest first."""
_TTY = Path("/sys/class/tty")
_ADAPTERS = Path("/sys/bus/usb-serial/devices")


def latency_timer(url: str) -> int | None:
    """The latency timer (ms) of the USB adapter at a port, as Linux tells it; None where there is none to tell."""
    setting = _TTY / Path(url).name / "device" / "latency_timer"
    try:
        return int(setting.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def latency_words(url: str, burst: float) -> str:
    """What to do about samples that come in bursts so far apart (s)."""
    found = latency_timer(url)
    name = Path(url).name
    what = (f"samples come in bursts, up to {1e3 * burst:.0f} ms apart: an adapter's latency timer"
            + (f", which stands at {found} ms" if found is not None else ""))
    if sys.platform == "win32":
        return (f"{what}; set it to 1 ms: Device Manager, Ports, {url}, Port Settings, Advanced, Latency Timer")
    if sys.platform == "darwin":
        return f"{what}; set LatencyTimer to 1 in the adapter's driver (FTDI: its Info.plist)"
    return (f"{what}; set it to 1 ms: `setserial {url} low_latency`, or "
            f"`echo 1 | sudo tee {_ADAPTERS / name / 'latency_timer'}` (a udev rule keeps it)")


def other_baud_rate(port: Port, known: tuple[int, ...] = BAUD_RATES) -> int | None:
    """The baud rate at which a Station device answers at this serial port; None: at none of those known.

    The port is left at the rate it had.
    """
    line = port.serial
    if not isinstance(line, serial.Serial) or not hasattr(line, "baudrate"):
        return None
    own = line.baudrate
    try:
        for rate in known:
            if rate == own:
                continue
            try:
                line.baudrate = rate
                line.reset_input_buffer()
                Client(port).identify(tries=2)
                return rate
            except (WorkError, ValueError, OSError):
                continue
    finally:
        line.baudrate = own
    return None


def protocol_differences(port: Port) -> list[str]:
    """Which messages of a device of another protocol are not this Station's, as far as they can be seen.

    It is asked who it is, for its statistics, and to stop: what it answers shows the lengths of its messages.
    """
    frames = []
    for name, values in (("identify", {"version": PROTOCOL.version, "hash": PROTOCOL.hash, "nonce": 1}), ("query", {}),
                         ("stop", {})):
        port.write(b"\0" + encode(MESSAGES[name].pack(**values)))
        end = time.perf_counter() + ANSWER_SECONDS
        data = b""
        while time.perf_counter() < end:
            data += port.read_waiting()
            if data.endswith(b"\0"):
                break
        frames += data.split(b"\0")
    seen: dict[int, int] = {}
    for frame in frames:
        body = any_body(frame)
        if body is not None:
            seen[body[0]] = len(body)
    words = []
    for code, length in sorted(seen.items()):
        message = MESSAGE_OF_CODE.get(code)
        if message is None:
            words.append(f"it sends a message of code {code:#04x}, which this Station does not know")
        elif length != message.body_size:
            words.append(f"its message {message.name} has {length} bytes, this Station's {message.body_size}")
    return words or ["the messages that it answers with have this Station's lengths: another one, or what their "
                     "numbers mean, differs"]


def explained(port: Port, error: WorkError) -> WorkError:
    """The failure to identify a device, with what was found out about its cause."""
    said = str(error)
    if "speaks protocol" in said:
        return WorkError(f"{said} ({'; '.join(protocol_differences(port))})")
    if "Station device" in said:
        rate = other_baud_rate(port)
        if rate is not None:
            return WorkError(f"{port.url}: a Station device answers at {rate} baud, not at {port.serial.baudrate}: "
                             f"give --baud {rate}")
    return error
