"""Who makes a simulated device tick: the host's own reading (lockstep), or a thread or process on the clock."""

from __future__ import annotations

import threading
import time
from typing import Protocol

from station.device.protocol import LIMITS
from station.device.simulated import CLOCK_HZ, SimulatedDevice

_GRACE = 0.05
"""Real seconds for which a thread that reads lets another one answer before the tick passes unanswered."""
_ANSWER_WAIT = 1.0
"""Real seconds for which a lockstep device in a process of its own waits for an answer."""
_LATE_WAKE = LIMITS["late_wake_us"] * 1e-6


class LockstepLine:
    """A device in the host's own process, in virtual time: it ticks when the host reads and nothing is left to read.

    A read lets as much virtual time pass as its timeout says, a tick without an answer included; a read with a
    timeout of 0 only the tick that the host has answered.  Otherwise time stands still.
    """

    def __init__(self, device: SimulatedDevice) -> None:
        self.device = device
        self._ready = threading.Condition()
        self._bytes = bytearray()
        self._writer: int | None = None
        self._ticks = 0
        self._clock_step = CLOCK_HZ / device.rate

    def write(self, data: bytes) -> None:
        """Bytes from the host."""
        with self._ready:
            self._writer = threading.get_ident()
            self.device.receive(data)
            self._bytes += self.device.transmit()
            self._ready.notify_all()

    def _tick(self) -> None:
        device = self.device
        device.tick(round(self._ticks * self._clock_step))
        self._bytes += device.transmit()
        device.advance()
        self._ticks += 1

    def _wait_for_another(self) -> bool:
        """Where another thread may answer, give it the time; whether it wrote."""
        core = self.device.core
        if threading.get_ident() == self._writer or (core.running and core.answered):
            return False
        return self._ready.wait(_GRACE)

    def read(self, size: int, timeout: float | None) -> bytes:
        """Up to size bytes, fewer where the (virtual) timeout passes."""
        core = self.device.core
        with self._ready:
            ticks = 0
            waited = timeout == 0.0
            may = float("inf") if timeout is None else timeout * self.device.rate + 1e-9
            while len(self._bytes) < size and not self.device.unplugged:
                if not waited:
                    waited = not self._wait_for_another()
                    continue
                if timeout is None and not core.running:
                    self._ready.wait(_GRACE)
                    continue
                if ticks + 1 > may and (ticks or not (core.running and core.answered)):
                    break
                self._tick()
                ticks += 1
            data = bytes(self._bytes[:size])
            del self._bytes[:size]
            return data

    def waiting(self) -> int:
        """Bytes that can be read now; a host that polls gets the tick that it has answered."""
        with self._ready:
            core = self.device.core
            if not self._bytes and core.running and core.answered:
                self._tick()
            return len(self._bytes)

    def clear(self) -> None:
        """Forget what was not read."""
        with self._ready:
            self._bytes.clear()

    def close(self) -> None:
        """Nothing runs on."""


class Link(Protocol):
    """The device's end of a line."""

    @property
    def connected(self) -> bool:
        """Whether a host is known, or may be, at the other end."""

    def receive(self, timeout: float) -> bytes:
        """Bytes from the host, at once when there are any; b"" when none came within timeout seconds."""

    def send(self, data: bytes) -> None:
        """Bytes to the host; never waits for it."""


def run_device(device: SimulatedDevice, link: Link, stop: threading.Event) -> None:
    """Serve a device at a link until ``stop``: ticks at absolute deadlines, or (speed 0) as soon as it is answered.

    A tick that begins more than 0.1 ms late says so in its sample; the next one is due at its own deadline all the
    same.  Where a whole period was missed the schedule starts again from now: missed ticks are not made up for.
    """
    clock = time.perf_counter
    begun = clock()
    to_clock = CLOCK_HZ / (device.period * device.rate)
    lockstep = device.options.speed == 0
    deadline = begun + device.period

    def take(data: bytes) -> None:
        device.receive(data)
        answer = device.transmit()
        if answer:
            link.send(answer)

    while not stop.is_set():
        in_step = lockstep and device.core.running
        if in_step:
            deadline = clock() + (_ANSWER_WAIT if link.connected else device.period)
        while not (in_step and device.core.answered):
            left = deadline - clock()
            data = link.receive(max(left, 0.0))
            if data:
                take(data)
                if lockstep and device.core.running != in_step:
                    break
            elif in_step and not link.connected:
                deadline = min(deadline, clock() + device.period)
            if left <= 0.0:
                break
        if lockstep and device.core.running != in_step:
            continue
        now = clock()
        device.tick(int((now - begun) * to_clock), not in_step and now - deadline > _LATE_WAKE)
        data = device.transmit()
        if data:
            link.send(data)
        device.advance()
        deadline += device.period
        if in_step or now > deadline:
            deadline = now + device.period


class PacedLine:
    """A device in the host's own process, in real time: a thread makes it tick."""

    connected = True

    def __init__(self, device: SimulatedDevice) -> None:
        self.device = device
        self._to_host, self._to_device = bytearray(), bytearray()
        self._host_ready = threading.Condition()
        self._device_ready = threading.Condition()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=run_device, args=(device, self, self._stop), daemon=True,
                                        name="simulated device")
        self._thread.start()

    def receive(self, timeout: float) -> bytes:
        """The device's side: bytes from the host."""
        with self._device_ready:
            if not self._to_device and timeout > 0.0:
                self._device_ready.wait(timeout)
            data = bytes(self._to_device)
            self._to_device.clear()
            return data

    def send(self, data: bytes) -> None:
        """The device's side: bytes to the host."""
        with self._host_ready:
            self._to_host += data
            self._host_ready.notify_all()

    def write(self, data: bytes) -> None:
        """Bytes from the host."""
        with self._device_ready:
            self._to_device += data
            self._device_ready.notify_all()

    def read(self, size: int, timeout: float | None) -> bytes:
        """Up to size bytes, fewer where the timeout passes."""
        end = None if timeout is None else time.perf_counter() + timeout
        with self._host_ready:
            while len(self._to_host) < size and not self.device.unplugged:
                left = 0.1 if end is None else end - time.perf_counter()
                if left <= 0.0:
                    break
                self._host_ready.wait(left)
            data = bytes(self._to_host[:size])
            del self._to_host[:size]
            return data

    def waiting(self) -> int:
        """Bytes that can be read now."""
        with self._host_ready:
            return len(self._to_host)

    def clear(self) -> None:
        """Forget what was not read."""
        with self._host_ready:
            self._to_host.clear()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        with self._device_ready:
            self._device_ready.notify_all()
        self._thread.join(timeout=2.0)


def line_of(device: SimulatedDevice) -> LockstepLine | PacedLine:
    """The line that the device's speed asks for."""
    return LockstepLine(device) if device.options.speed == 0 else PacedLine(device)
