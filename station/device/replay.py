"""A recorded run behind the firmware core: the samples are the log's, whatever the host commands."""

from __future__ import annotations

import random
import zlib

import numpy as np

from station.control.rounding import round_half_up
from station.device.simulated import Options, SimulatedDevice
from station.errors import UsageError
from station.rig import builtin_rigs, load_rig
from station.runs.replay import command_limit
from station.runs.run import Run

_INT16 = 0x7FFF


class RecordedSource:
    """Row i of the log is read at tick i of a session; the first row before it, the last row after its end.

    Counts are rounded half up where a log holds fractions, and cut to what a sample can carry.
    """

    def __init__(self, run: Run) -> None:
        accel = np.zeros(len(run)) if run.accel is None else run.accel
        self._rows = [(round_half_up(encoder), min(max(round_half_up(a), -_INT16), _INT16))
                      for encoder, a in zip(run.encoder, accel, strict=True)]
        self._row = 0

    def begin(self) -> None:
        """A session begins: the log from its first row."""
        self._row = 0

    def sample(self) -> tuple[int, int]:
        """Encoder and accelerometer of this row, counts."""
        return self._rows[self._row]

    def advance(self, drive: int, enabled: bool) -> None:
        """On to the next row, in a session; the drive moves nothing."""
        if enabled and self._row < len(self._rows) - 1:
            self._row += 1


def _limit(run: Run) -> float:
    """The amplifier's limit of the run's own rig; where it holds none, the largest command of the log."""
    try:
        return command_limit(run)
    except UsageError:
        if isinstance(run.metadata.rig, str) and run.metadata.rig in builtin_rigs():
            return load_rig(run.metadata.rig).command_limit
        return float(max(np.ceil(np.max(np.abs(run.command))), 1.0))


def replay_device(run: Run, options: Options | None = None) -> SimulatedDevice:
    """The device that answers as the logged run did; WorkError where ticks are missing in the log."""
    run.require_unbroken()
    options = options or Options()
    boot = random.getrandbits(32) if options.seed is None else zlib.crc32(run.name.encode())
    return SimulatedDevice("replay", RecordedSource(run), run.sample_rate, _limit(run), options, boot)
