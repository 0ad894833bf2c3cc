"""The simulated device: the firmware core itself, driving a plant model (or a recorded run) in place of a rig."""

from __future__ import annotations

import math
import random
import zlib
from dataclasses import dataclass, field
from typing import Protocol

from station.device.core import Board, Core
from station.device.faults import Faults, FaultyLine
from station.device.limits import NO_LIMITS, DeviceLimits
from station.device.protocol import LIMITS, BoardFlags, InputFlags
from station.errors import UsageError
from station.model import stepper
from station.model.effects.base import Stage
from station.model.simulate import Plant, initial_state
from station.rig import Rig

_INT16 = 0x7FFF
CLOCK_HZ = 1_000_000
BRAKED_AFTER = 2e-3 * LIMITS["rest_time_ms"]
"""So long (s) an arm that coasts must stay within one count before it is held: twice what a device calls rest."""


class Source(Protocol):
    """What the sensors read and what the drive acts on."""

    def begin(self) -> None:
        """A session begins at the coming tick."""

    def sample(self) -> tuple[int, int]:
        """Encoder and accelerometer at this tick, counts."""

    def advance(self, drive: int, enabled: bool) -> None:
        """Hold the drive (counts) to the next tick; ``enabled``: the drive's enable pin, active in a session alone."""


class _Rig(Plant):
    """A plant that can be released again where it stands."""

    def release(self, accel_noise: float) -> None:
        """At rest at the present angle, springs relaxed, lags and delays empty: as a run that is ``released``."""
        plan = self.model.plan
        self._state = initial_state(self.model, float(plan.base_angle @ self._state.z))
        stepper.begin(plan, self._state)
        self.stay(accel_noise)

    def stay(self, accel_noise: float) -> None:
        """Held still for one period."""
        self._out[:] = stepper.sense(self.model.plan, self._state, self._offset + accel_noise, True)


def idle_command(rig: Rig) -> float:
    """The command (counts) at which the rig's drive pushes neither way, its bias included: a drive that is off.

    Found by bisection, as every law of the command chain rises with its command.
    """
    chain = sorted((e for e in rig.effects if e.stage is Stage.COMMAND and not e.states), key=lambda e: e.order)

    def out(count: float) -> float:
        for effect in chain:
            count = type(effect).law(count, 0.0, rig.amplifier.limit, effect.arguments(rig), [0.0], 0.0)
        return count

    low, high = -rig.amplifier.limit, rig.amplifier.limit
    if out(0.0) == 0.0 or out(low) > 0.0 or out(high) < 0.0:
        return 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if out(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)


class PlantSource:
    """The plant model of a rig.  Where the drive is off the arm coasts, until it rests and a brake holds it; each
    session releases it at rest where it stands.

    ``noise`` is the accelerometer's standard deviation, counts; it joins a reading before that is clipped and rounded.
    """

    def __init__(self, rig: Rig, angle: float, accel_offset: float, noise: float, seed: int) -> None:
        self._plant = _Rig(rig, angle, accel_offset)
        self._noise = noise
        self._gauss = random.Random(seed).gauss
        self._idle = idle_command(rig)
        self._rest_ticks = max(math.ceil(BRAKED_AFTER * rig.sample_rate), 1)
        self._resting = self._rest_ticks  # ticks for which the arm has stayed within one count of ``_rested``
        self._rested = 0

    def _drawn(self) -> float:
        return self._gauss(0.0, self._noise) if self._noise else 0.0

    def begin(self) -> None:
        """A session begins at the coming tick."""
        self._plant.release(self._drawn())

    def sample(self) -> tuple[int, int]:
        """Encoder and accelerometer at this tick, counts, cut to 16 bits."""
        encoder, accel = self._plant.sample()
        return encoder, min(max(accel, -_INT16), _INT16)

    def advance(self, drive: int, enabled: bool) -> None:
        """Hold the drive to the next tick; where it is not enabled the arm coasts to rest."""
        if enabled:
            self._plant.advance(drive, self._drawn())
            self._resting = 0
        elif self._resting < self._rest_ticks:
            self._plant.advance(self._idle, self._drawn())
            encoder, _ = self._plant.sample()
            if self._resting == 0 or abs(encoder - self._rested) > 1:
                self._rested, self._resting = encoder, 0
            self._resting += 1
        elif self._noise:
            self._plant.stay(self._drawn())


@dataclass(frozen=True)
class Options:
    """How a simulated device behaves.  speed 0: lockstep, as fast as the host answers; 1: real time.

    noise: accelerometer, counts (one sigma); angle: where the rig stands at first, rad; accel_offset: counts.
    """

    speed: int = 0
    seed: int | None = None
    noise: float = 0.0
    angle: float = 0.0
    accel_offset: float = 0.0
    faults: Faults = field(default_factory=Faults)


def rig_source(rig: Rig, options: Options) -> tuple[PlantSource, float, int]:
    """The plant behind a device, the true sample period (s), and the number of this power-up."""
    boot = random.getrandbits(32) if options.seed is None else zlib.crc32(f"{options} {rig.to_toml()}".encode())
    scale = next((effect.values()["ratio"] for effect in rig.effects if effect.name == "clock_scale"), 1.0)
    return PlantSource(rig, options.angle, options.accel_offset, options.noise, boot), rig.period * scale, boot


class SimulatedDevice:
    """The firmware core with a source of samples behind it.  Who owns it gives it bytes and calls its ticks."""

    def __init__(self, name: str, source: Source, rate: float, limit: float, options: Options, boot: int,
                 true_period: float | None = None, limits: DeviceLimits | None = None) -> None:
        if not 1.0 <= limit <= _INT16:
            raise UsageError(f"{name}: amplifier.limit {limit:g} counts; a device's command has 1 to {_INT16}")
        flags = BoardFlags.VIRTUAL_TIME if options.speed == 0 else 0
        board = Board(name, round(rate * 1000.0), math.floor(limit), boot, CLOCK_HZ, int(flags),
                      limits or NO_LIMITS)
        self.options = options
        self.rate = rate
        self.period = true_period or 1.0 / rate
        self.core = Core(board, random.getrandbits(32) if options.seed is None else boot ^ 0x5DEECE66)
        self.line = FaultyLine(options.faults, boot)
        self._source = source
        self._session_ticks = 0
        self._faulty = options.faults.on_frames

    @classmethod
    def of_rig(cls, rig: Rig, options: Options | None = None) -> SimulatedDevice:
        """The rig as a device, its limits compiled in; UsageError where limit or rate cannot be a device's."""
        options = options or Options()
        source, true_period, boot = rig_source(rig, options)
        return cls(rig.name, source, rig.sample_rate, rig.command_limit, options, boot, true_period,
                   DeviceLimits.of_rig(rig))

    @property
    def silent(self) -> bool:
        """Whether the fault of silence has set in: no tick, no answer."""
        after = self.options.faults.silent_after
        return after is not None and self._session_ticks >= after

    @property
    def unplugged(self) -> bool:
        """Whether the fault of a pulled cable has set in."""
        after = self.options.faults.unplug_after
        return after is not None and self._session_ticks >= after

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        if not self.silent:
            self.core.receive(self.line.carry("host", data) if self._faulty else data)

    def transmit(self) -> bytes:
        """Bytes for the host."""
        data = self.core.transmit()
        if self.silent:
            return b""
        return self.line.carry("device", data) if self._faulty and data else data

    def tick(self, clock: int, woke_late: bool = False) -> None:
        """One tick at a reading of the board's clock (microseconds): sensors, core.  ``advance`` must follow."""
        if self.core.beginning:
            self._source.begin()
            self._session_ticks = 0
        if self.core.running:
            self._session_ticks += 1
        encoder, accel = self._source.sample()
        self.core.tick(clock, encoder, accel, int(InputFlags.WOKE_LATE) if woke_late else 0)
        if self._faulty:
            self.core.receive(self.line.overdue())

    def advance(self) -> None:
        """Let the drive act on the rig for one period."""
        self._source.advance(self.core.drive, self.core.enabled)
