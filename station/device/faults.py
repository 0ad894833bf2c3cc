"""Faults of the line and the device, put in for tests: frames lost, flipped, repeated, late or
overtaken; silence; a pulled cable.

They touch samples and commands alone, so that a run can be set up and every fault put in can be counted against
what host and device report.  A flip changes one bit inside a frame and neither makes nor breaks a delimiter: one
flip is one corrupt frame.
"""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass

from station.device.protocol import MESSAGE_OF_CODE

_NEVER = {"late": "sample", "reorder": "command"}
"""A fault, and the frames that it does not touch."""


@dataclass(frozen=True)
class Faults:
    """Probabilities per frame, for frames named ``sample`` or ``command`` in ``on``; ticks of a session after which."""

    drop: float = 0.0
    flip: float = 0.0
    duplicate: float = 0.0
    late: float = 0.0
    reorder: float = 0.0
    on: tuple[str, ...] = ("sample", "command")
    silent_after: int | None = None
    unplug_after: int | None = None

    @property
    def on_frames(self) -> bool:
        """Whether frames are touched at all."""
        return any((self.drop, self.flip, self.duplicate, self.late, self.reorder))

    @property
    def any(self) -> bool:
        """Whether there is a fault at all."""
        return self.on_frames or self.silent_after is not None or self.unplug_after is not None


class FaultyLine:
    """Passes bytes on, frame by frame, with faults; ``counts[message, kind]`` is what was put in."""

    def __init__(self, faults: Faults, seed: int) -> None:
        self.faults = faults
        self.counts: Counter[tuple[str, str]] = Counter()
        self._random = random.Random(seed)
        self._late: list[bytes] = []
        self._overtaken: dict[str, bytes] = {}
        self._rest = {"host": b"", "device": b""}

    def _flipped(self, frame: bytes) -> bytes:
        while True:
            at, bit = self._random.randrange(len(frame) - 1), 1 << self._random.randrange(8)
            if frame[at] != bit:
                return frame[:at] + bytes([frame[at] ^ bit]) + frame[at + 1:]

    def _touch(self, frame: bytes) -> bytes:
        try:
            name = MESSAGE_OF_CODE[frame[1]].name
        except (IndexError, KeyError):
            return frame
        if name not in self.faults.on or name not in ("sample", "command"):
            return frame
        overtaken = self._overtaken.pop(name, b"")
        return frame + overtaken if overtaken else self._hit(name, frame)

    def _hit(self, name: str, frame: bytes) -> bytes:
        """The frame with at most one fault."""
        for kind in ("drop", "flip", "duplicate", "late", "reorder"):
            if _NEVER.get(kind) == name or self._random.random() >= getattr(self.faults, kind):
                continue
            self.counts[name, kind] += 1
            if kind == "drop":
                return b""
            if kind == "flip":
                return self._flipped(frame)
            if kind == "duplicate":
                return frame + frame
            if kind == "reorder":
                self._overtaken[name] = frame  # it comes after the next one of its kind
                return b""
            self._late.append(frame)
            return b""
        return frame

    def carry(self, sender: str, data: bytes) -> bytes:
        """What arrives of the bytes that ``sender`` (host or device) has sent."""
        *frames, self._rest[sender] = (self._rest[sender] + data).split(b"\0")
        return b"".join(self._touch(frame + b"\0") for frame in frames)

    def overdue(self) -> bytes:
        """The commands held back, to be delivered after the tick that they were meant for."""
        late, self._late = b"".join(self._late), []
        return late
