"""The firmware core in this process: the host board's library through cffi, its declarations read from the headers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from cffi import FFI

from station.device import header
from station.device.build import build, source_hash
from station.device.firmware import firmware_folder
from station.device.limits import NO_LIMITS, DeviceLimits
from station.device.protocol import PROTOCOL, State
from station.errors import WorkError

_BEGIN, _END = "/* declarations: begin", "/* declarations: end"


def _declarations() -> str:
    """The protocol's declarations and the marked parts of the core's and the host board's sources."""
    parts = [header.declarations(), header.states_declarations()]
    for name in ("core/core.h", "boards/host/host.c"):
        text = (firmware_folder() / name).read_text(encoding="utf-8")
        part = text[text.index(_BEGIN):text.index(_END)]
        parts.append(part[part.index("*/") + 2:])
    return "\n".join(parts)


@cache
def library() -> tuple[FFI, Any]:
    """cffi's handle and the library, built where needed; WorkError where the two do not fit together."""
    ffi = FFI()
    ffi.cdef(_declarations())
    path = build()
    try:
        lib = ffi.dlopen(str(path))
    except OSError as error:
        raise WorkError(f"{path}: the compiled firmware core cannot be loaded ({error}); remove it") from None
    if lib.station_protocol_hash() != PROTOCOL.hash:
        raise WorkError(f"{path}: built for another protocol; run `python -m station.device.header`")
    row = lib.station_sizes
    index = 0
    while row[index].name != ffi.NULL:
        name = ffi.string(row[index].name).decode()
        if ffi.sizeof(name) != row[index].size:
            raise WorkError(f"{path}: {name} has {row[index].size} bytes, {ffi.sizeof(name)} as declared; "
                            "the library is not of these sources, remove it")
        index += 1
    return ffi, lib


@dataclass(frozen=True)
class Board:
    """What the host board says of itself; rates in mHz, limits in counts, the allowance in us."""

    name: str
    rate: int
    command_limit: int
    boot: int
    clock_hz: int = 1_000_000
    flags: int = 0
    limits: DeviceLimits = NO_LIMITS
    baud_rate: int = 0
    allowance: int = 0
    rate_min: int = 0
    """0: the same as ``rate``."""

    def structure(self, build: int) -> dict[str, Any]:
        """The fields of a station_board."""
        return {"boot": self.boot, "clock_hz": self.clock_hz, "rate_min": self.rate_min or self.rate,
                "rate_max": self.rate, "build": build, "command_limit": self.command_limit, "flags": self.flags,
                "baud_rate": self.baud_rate, "allowance": self.allowance, "travel_limit": self.limits.travel,
                "speed_limit": self.limits.speed, "stall_command": self.limits.stall_command,
                "stall_time": self.limits.stall_time, "name": self.name.encode("ascii", "replace")[:16]}


class Core:
    """One firmware core: bytes of the line in and out, and its tick."""

    def __init__(self, board: Board, entropy: int) -> None:
        self._ffi, self._lib = library()
        self._core = self._ffi.new("station_core *")
        self._input = self._ffi.new("station_input *")
        self._output = self._ffi.new("station_output *")
        described = self._ffi.new("station_board *", board.structure(source_hash()))
        self._lib.station_init(self._core, described, entropy & 0xFFFFFFFF)
        self._size, self._slots = self._lib.STATION_TRANSMIT_BYTES, self._lib.STATION_SLOTS
        self._bytes = self._ffi.new("uint8_t[]", self._size)
        self._buffer = self._ffi.buffer(self._bytes)

    def receive(self, data: bytes) -> None:
        """Bytes from the line."""
        for start in range(0, len(data), 0x4000):
            piece = data[start:start + 0x4000]
            self._lib.station_receive(self._core, piece, len(piece))

    def tick(self, clock: int, encoder: int, accel: int, flags: int = 0) -> int:
        """One tick with the sensors read at it; returns the drive (counts) in force until the next."""
        given = self._input
        given.clock = clock & 0xFFFFFFFF
        given.encoder = encoder
        given.accel = accel
        given.flags = flags
        self._lib.station_tick(self._core, given, self._output)
        return self._output.drive

    def transmit(self, most: int | None = None) -> bytes:
        """Bytes for the line, ``most`` at most, taken away."""
        return self._buffer[:self._lib.station_transmit(self._core, self._bytes, self._size if most is None else most)]

    @property
    def waiting(self) -> int:
        """Bytes that wait for the line."""
        return self._core.transmit

    @property
    def state(self) -> State:
        """The state machine's state."""
        return State(self._core.state)

    @property
    def running(self) -> bool:
        """Whether a session is on."""
        return self._core.state == State.RUNNING

    @property
    def beginning(self) -> bool:
        """Whether the coming tick is a session's first."""
        core = self._core
        return core.first_ticks > 0 and core.next_index == 0 and core.state == State.RUNNING

    @property
    def drive(self) -> int:
        """The drive applied now, counts."""
        return self._core.drive

    @property
    def command_limit(self) -> int:
        """The limit in force, counts."""
        return self._core.config.command_limit

    @property
    def enabled(self) -> bool:
        """The drive's enable pin, as the board would set it now."""
        self._lib.station_present(self._core, self._output)
        return bool(self._output.enable)

    @property
    def answered(self) -> bool:
        """Whether the coming tick has its command, or cannot have one yet."""
        core = self._core
        return bool(core.first_ticks or core.slot_full[core.next_index % self._slots])
