"""What is asked of a test before its device is armed, and of every sample while it runs."""

from __future__ import annotations

from collections import deque
from math import isfinite

import numpy as np

from station.control.compensators import Compensator
from station.control.references import LEAST_REST
from station.device.limits import SPEED_TICKS, DeviceLimits
from station.errors import UsageError, WorkError
from station.rig import Rig

FIRST_COMMAND_SHARE = 0.1
"""A test whose first command is a larger share of the limit than this does not begin at rest."""


def require_rest(reference: np.ndarray, rate: float, open_loop: bool) -> None:
    """UsageError where the reference (counts) does not rest for LEAST_REST seconds at its beginning.

    Rest is a constant reference; in open loop, where the reference is the command, it is 0.
    """
    beginning = reference[:round(LEAST_REST * rate)]
    level = 0.0 if open_loop else reference[0]
    if len(beginning) < round(LEAST_REST * rate) or np.any(beginning != level):
        raise UsageError(f"reference: a test begins with at least {LEAST_REST:g} s at rest "
                         f"({'command 0' if open_loop else 'a constant reference'})")


def require_small_first_command(url: str, rate: float, compensator: Compensator, reference: float, encoder: float,
                                accel_zero: float) -> None:
    """UsageError where the command (counts) that a test begins with is beyond FIRST_COMMAND_SHARE of the limit."""
    fresh = Compensator.from_spec(compensator.spec, rate, compensator.limit)
    fresh.reset(accel_zero)
    first = fresh.step(reference, encoder, accel_zero)
    if abs(first) > FIRST_COMMAND_SHARE * compensator.limit:
        raise UsageError(f"{url}: the first command would be {first:.0f} counts, more than "
                         f"{100.0 * FIRST_COMMAND_SHARE:.0f} % of the limit of {compensator.limit:g}: the arm rests at "
                         f"{encoder:g} counts, the reference begins at {reference:g}; bring the arm there, or let the "
                         "reference begin where the arm is")


def require_within_limits(rig: Rig, reference: np.ndarray, open_loop: bool) -> None:
    """UsageError where a test asks for more than the rig's ``[limits]`` allow, before anything moves.

    In closed loop the reference (counts) is where the arm is to go, from its first value on; in open loop it is the
    command.
    """
    limits = rig.limits
    if limits is None:
        return
    if open_loop:
        asked = float(np.max(np.abs(reference)))
        if limits.command is not None and asked > limits.command:
            raise UsageError(f"test.amplitude: a command of {asked:g} counts; rig {rig.name} has limits.command = "
                             f"{limits.command:g}")
        return
    asked = float(np.max(np.abs(reference - reference[0]))) * rig.angle_per_count
    if limits.travel is not None and asked > limits.travel:
        raise UsageError(f"test.amplitude: a reference {asked:.4g} rad from where it begins; rig {rig.name} has "
                         f"limits.travel = {limits.travel:g}")


STALL_SHARE, STALL_SECONDS = 0.5, 0.5
"""A command of this share of the limit, held so long, moves every arm that is free and every encoder that works."""


class Guard:
    """The host's own watch while a test runs: travel and speed, in counts as the device holds them (0: no limit), and
    an encoder that stands still under a large command (``limit``: the command's, counts; ``rate``: Hz)."""

    def __init__(self, url: str, limits: DeviceLimits, start: int, limit: float, rate: float) -> None:
        self._url, self.limits, self.start = url, limits, start
        self._last = deque([start] * SPEED_TICKS, SPEED_TICKS)
        self.limited = bool(limits.travel or limits.speed)
        self.level, self.patience = STALL_SHARE * limit, max(round(STALL_SECONDS * rate), 2)
        self._stood, self._still = start, 0

    def drive(self, row: int, encoder: int, command: float) -> None:
        """WorkError where the command (counts) is no number, or has been large for STALL_SECONDS and the encoder stood
        still."""
        if not isfinite(command):
            raise self.no_number(row)
        if abs(command) < self.level or abs(encoder - self._stood) > 1:
            self._stood, self._still = encoder, 0
            return
        self._still += 1
        if self._still >= self.patience:
            raise self.stalled(row, command)

    def see(self, row: int, encoder: int) -> None:
        """WorkError where the encoder's reading (counts) of this row is beyond a limit."""
        travel, speed = abs(encoder - self.start), abs(encoder - self._last[0])
        self._last.append(encoder)
        if self.limits.travel and travel > self.limits.travel:
            raise self.too_far(row, travel)
        if self.limits.speed and speed > self.limits.speed:
            raise self.too_fast(row, speed)

    def no_number(self, row: int) -> WorkError:
        """What is said of a controller whose states have grown without bound."""
        return WorkError(f"{self._url}: the controller's command was no number at row {row}, and the test was stopped; "
                         "its states grow without bound: see that its denominators are stable")

    def stalled(self, row: int, command: float) -> WorkError:
        """What is said of a motor that drives and moves nothing."""
        return WorkError(f"{self._url}: the motor was driven at {abs(command):.0f} counts for {STALL_SECONDS:g} s "
                         f"and the encoder stood still; stopped at row {row}; see what holds "
                         "the arm, the motor's power, and the encoder's cable")

    def too_far(self, row: int, travel: float) -> WorkError:
        """What is said of an arm beyond the limit of travel (counts)."""
        return WorkError(f"{self._url}: the arm went {travel:.0f} counts from where it began, the limit is "
                         f"{self.limits.travel}; stopped at row {row}; bring the arm back, then ask for less")

    def too_fast(self, row: int, speed: float) -> WorkError:
        """What is said of an arm beyond the limit of speed (counts in SPEED_TICKS ticks)."""
        return WorkError(f"{self._url}: the encoder moved {speed:.0f} counts in {SPEED_TICKS} ticks, the limit is "
                         f"{self.limits.speed}; stopped at row {row}; ask for less, and see that the encoder counts "
                         "well")


def clipped_rows(reference: np.ndarray, limit: float, open_loop: bool) -> int:
    """Rows of an open-loop test whose command (counts) is cut to the limit; 0 in closed loop."""
    return int(np.count_nonzero(np.abs(reference) > limit)) if open_loop else 0
