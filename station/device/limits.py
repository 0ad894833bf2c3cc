"""A rig's limits in the counts that a device holds."""

from __future__ import annotations

import math
from dataclasses import dataclass

from station.device.protocol import LIMITS
from station.errors import UsageError
from station.rig import Rig

SPEED_TICKS = LIMITS["speed_ticks"]
_UINT16, _UINT32 = 0xFFFF, 0xFFFFFFFF


@dataclass(frozen=True)
class DeviceLimits:
    """Each 0 where there is none.

    travel: counts from the start of a session; speed: counts within SPEED_TICKS ticks; a drive above
    stall_command (counts) must move the encoder within stall_time (ms).
    """

    travel: int = 0
    speed: int = 0
    stall_command: int = 0
    stall_time: int = 0

    @classmethod
    def of_rig(cls, rig: Rig) -> DeviceLimits:
        """``limits.travel`` and ``limits.speed`` of a rig, in counts.

        Travel is rounded down (but 1 count at least).  Speed is rounded up: a reading in whole counts may differ by
        nearly one count more than the arm has moved, and an arm below the limit must not trip it.  UsageError where it
        is more than the protocol has room for.
        """
        limits = rig.limits
        travel = speed = 0
        if limits is not None and limits.travel is not None:
            travel = min(max(math.floor(limits.travel / rig.angle_per_count), 1), _UINT32)
        if limits is not None and limits.speed is not None:
            speed = math.ceil(limits.speed * SPEED_TICKS * rig.period / rig.angle_per_count)
            if speed > _UINT16:
                raise UsageError(f"limits.speed: {limits.speed:g} rad/s of rig {rig.name} are {speed} counts in "
                                 f"{SPEED_TICKS} ticks, and a device holds {_UINT16}; take less than "
                                 f"{limits.speed * _UINT16 / speed:.3g} rad/s, or leave it out")
        return cls(travel, speed)

    def within(self, own: DeviceLimits) -> DeviceLimits:
        """The tighter of each, ``own`` being the device's."""
        return DeviceLimits(*(min(mine or its, its or mine) for mine, its in (
            (self.travel, own.travel), (self.speed, own.speed), (self.stall_command, own.stall_command),
            (self.stall_time, own.stall_time))))


NO_LIMITS = DeviceLimits()
