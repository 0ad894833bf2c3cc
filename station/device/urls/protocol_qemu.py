"""qemu://RIG: the simulated rig behind the emulated Cortex-M3 board; RIG and options as for sim://, without faults.

``qemu://sflr`` runs in lockstep, ``qemu://sflr?speed=1`` in real time.  The emulator is a process that ends with this
one.
"""

from __future__ import annotations

import shutil

from serial.serialutil import SerialException
from serial.urlhandler import protocol_socket

from station.device.emulator import BOARDS, QEMU
from station.device.server import DeviceProcess
from station.device.urls.handler import parse_url
from station.errors import StationError, UsageError
from station.rig import load_rig


def device_process(url: str) -> DeviceProcess:
    """The process that a URL describes; UsageError in one line otherwise."""
    name, others, options = parse_url(url, "qemu", frozenset({"rig"}))
    rig = others.get("rig") or name
    if not rig:
        raise UsageError(f"{url}: which rig? qemu://sflr, or qemu://?rig=FILE")
    if options.faults.any:
        raise UsageError(f"{url}: faults of the line are for sim:// alone")
    if shutil.which(QEMU) is None:
        raise UsageError(f"{url}: {QEMU} is missing; on Debian: apt install qemu-system-arm")
    load_rig(rig)
    return DeviceProcess(rig, pty=False, speed=options.speed, seed=options.seed, noise=options.noise, board=BOARDS[0],
                         options=("--angle", str(options.angle), "--accel-offset", str(options.accel_offset)))


class Serial(protocol_socket.Serial):
    """pyserial's port class for qemu://: its socket class, at the emulated chip's UART."""

    _device: DeviceProcess | None = None

    def open(self) -> None:
        """Start the emulator and connect; SerialException where that fails."""
        if self.is_open:
            raise SerialException("Port is already open.")
        try:
            self._device = device_process(self.portstr).__enter__()
        except StationError as error:
            raise SerialException(str(error)) from error
        super().open()

    def from_url(self, url: str) -> tuple[str, int]:
        """Where the emulator listens."""
        host, port = self._device.addresses.tcp.removeprefix("socket://").rsplit(":", 1)
        return host, int(port)

    def close(self) -> None:
        """Hang up, and end the emulator."""
        super().close()
        if self._device is not None:
            device, self._device = self._device, None
            device.__exit__(None, None, None)
