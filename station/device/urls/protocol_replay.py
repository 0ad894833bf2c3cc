"""replay://FILE: a device whose sensors read what a logged run's did."""

from __future__ import annotations

from station.device.replay import replay_device
from station.device.simulated import SimulatedDevice
from station.device.urls.handler import DeviceSerial, parse_url
from station.errors import UsageError
from station.runs import load_run


def make_device(url: str) -> SimulatedDevice:
    """The device that a URL describes; WorkError where the run cannot be read."""
    path, _, options = parse_url(url, "replay")
    if not path:
        raise UsageError(f"{url}: which run? replay://FILE")
    return replay_device(load_run(path), options)


class Serial(DeviceSerial):
    """pyserial's port class for replay://."""

    make_device = staticmethod(make_device)
