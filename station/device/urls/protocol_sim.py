"""sim://RIG: the simulated rig, RIG a built-in name or a file (also ``?rig=FILE``); options in ``Options``, ``Faults``.

``sim://sflr`` runs in lockstep, ``sim://sflr?speed=1`` in real time; ``sim://sealed-1`` hides an effect.
"""

from __future__ import annotations

from station.device.sealed import simulated_rig
from station.device.simulated import SimulatedDevice
from station.device.urls.handler import DeviceSerial, parse_url
from station.errors import UsageError


def make_device(url: str) -> SimulatedDevice:
    """The device that a URL describes; UsageError in one line otherwise."""
    name, others, options = parse_url(url, "sim", frozenset({"rig"}))
    rig = others.get("rig") or name
    if not rig:
        raise UsageError(f"{url}: which rig? sim://sflr, or sim://?rig=FILE")
    return SimulatedDevice.of_rig(simulated_rig(rig), options)


class Serial(DeviceSerial):
    """pyserial's port class for sim://."""

    make_device = staticmethod(make_device)
