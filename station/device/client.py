"""The host's end of the protocol: requests that are answered, and a motor that is brought to rest."""

from __future__ import annotations

import functools
import secrets
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from station.device.framing import Decoder, encode
from station.device.limits import NO_LIMITS, DeviceLimits
from station.device.port import TIMEOUT, Port
from station.device.protocol import (
    LIMITS,
    MESSAGE_OF_CODE,
    MESSAGES,
    PROTOCOL,
    BoardFlags,
    Fault,
    Reset,
    Result,
    State,
    Status,
)
from station.errors import WorkError

ANSWER_SECONDS = 0.3
"""So long a request waits for its answer before it is sent again."""
TRIES = 5
_MOST_BYTES = 100_000
"""A line that brings more and no answer is not a device's."""
_IDENTITY = MESSAGES["identity"].code
_WORDS = {
    Result.WRONG_STATE: "it is {state}",
    Result.WRONG_PROTOCOL: "it was reset since it was identified, or its protocol is another; try again",
    Result.STALE: "the request is from an earlier connection",
    Result.NOT_CONFIGURED: "it is not configured since it was last identified",
    Result.OUT_OF_RANGE: "a value is beyond what its firmware allows",
    Result.MOVING: "the arm is moving",
    Result.ESTOP_OPEN: "its e-stop is open; close it",
    Result.LINE_TOO_SLOW: "its line cannot carry sample and command in time at this rate; "
                          "take a higher baud rate, more answer_ticks or a lower sample rate",
}


@dataclass(frozen=True)
class Identity:
    """What a device says of itself; rates in Hz, limits in counts, ``allowance`` (of each answer) in s.

    ``baud_rate`` is 0 where the device's line has none; ``reset``: why it was last reset.
    """

    board: str
    build: int
    boot: int
    zeroings: int
    clock_hz: int
    rate_min: float
    rate_max: float
    command_limit: int
    virtual_time: bool
    reset: Reset | int
    state: State
    limits: DeviceLimits = NO_LIMITS
    baud_rate: int = 0
    allowance: float = 0.0

    @property
    def zero_id(self) -> str:
        """Names the encoder's zero: the same until the device is powered down or zeroed."""
        return f"{self.boot:08x}.{self.zeroings}"

    @property
    def rates(self) -> str:
        """At which sample rates it runs, for people."""
        ends = f"{self.rate_min:g}", f"{self.rate_max:g}"
        return f"{' to '.join(dict.fromkeys(ends))} Hz"

    @property
    def reset_words(self) -> str:
        """Why it was last reset, for people."""
        return self.reset.name.lower() if isinstance(self.reset, Reset) else f"code {self.reset}"

    def summary(self) -> dict[str, Any]:
        """For a run's metadata."""
        return {"board": self.board, "build": f"{self.build:08x}", "protocol": PROTOCOL.version,
                "protocol_hash": f"{PROTOCOL.hash:08x}", "boot": f"{self.boot:08x}",
                "command_limit": self.command_limit, "clock_hz": self.clock_hz, "virtual_time": self.virtual_time,
                "reset": self.reset_words}


class Client:
    """Speaks with the device at a port.  ``session`` is 0 unless a run is on; ``paced``: the device's ticks follow
    the wall clock.

    Every method raises WorkError, one line that names the port, where the device does not answer or refuses.
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self.decoder = Decoder()
        self.inbox: deque[bytes] = deque()
        self.session = self.last_session = 0
        self.paced = True
        self._tries = self._seen = 0
        self._challenge = 0
        self._limits = NO_LIMITS

    def _once(self, data: bytes, accept: Callable[[bytes], Any]) -> Any:
        """Send and wait for the first body that ``accept`` makes something of; the others are kept in ``inbox``.

        None where nothing came within ANSWER_SECONDS, whatever else did: a line that babbles holds nobody up.
        """
        self.port.write(data)
        waited, end = 0.0, time.perf_counter() + ANSWER_SECONDS
        while waited < ANSWER_SECONDS and time.perf_counter() < end and self._seen <= _MOST_BYTES:
            data = self.port.read_waiting()
            if not data:
                waited += TIMEOUT
            self._seen += len(data)
            found = None
            for body in self.decoder.feed(data):
                taken = accept(body) if found is None else None
                if taken is None:
                    self.inbox.append(body)
                else:
                    found = taken
            if found is not None:
                return found
        return None

    def _request(self, name: str, answer: str, before: bytes = b"", **values: Any) -> Any:
        """Send until the answer comes.  ``before``: bytes sent together with it."""
        wanted, code = MESSAGES[answer], MESSAGES[name].code
        frame = before + encode(MESSAGES[name].pack(**values))

        def accept(body: bytes) -> Any:
            if body[0] != wanted.code:
                return None
            message = wanted.unpack(body)
            return message if answer != "reply" or message.request == code else None

        self._seen = 0
        for _ in range(TRIES):
            if (found := self._once(frame, accept)) is not None:
                return found
        raise WorkError(f"{self.port.url}: no answer to {name}; the device is gone or the line is bad")

    def _no_station(self, seen: int) -> WorkError:
        if seen:
            return WorkError(f"{self.port.url}: not a Station device ({seen} bytes came, none of them an answer); "
                             "check port, firmware and baud rate")
        return WorkError(f"{self.port.url}: no Station device answers; check port, cable and firmware")

    def _identity(self, body: bytes, nonce: int) -> Any:
        """The identity that answers this very request; one that the line has stored is not it."""
        if body[0] != _IDENTITY:
            return None
        self._require_protocol(body)
        found = MESSAGES["identity"].unpack(body)
        return found if found.nonce == nonce else None

    def _require_protocol(self, body: bytes) -> None:
        version, number = int.from_bytes(body[1:3], "little"), int.from_bytes(body[3:7], "little")
        if (version, number) != (PROTOCOL.version, PROTOCOL.hash):
            raise WorkError(f"{self.port.url}: the device speaks protocol {version} ({number:08x}), this Station "
                            f"{PROTOCOL.version} ({PROTOCOL.hash:08x}); put the matching firmware on the board")

    def _ask(self, name: str, **values: Any) -> Any:
        """A request that is answered by a reply; WorkError says why it was refused."""
        reply = self._request(name, "reply", **values)
        if reply.result != Result.OK:
            result = Result(reply.result) if reply.result in Result._value2member_map_ else None
            words = _WORDS.get(result, f"result {reply.result}")
            raise WorkError(f"{self.port.url}: the device refuses {name}: "
                            f"{words.format(state=state_words(reply.state, reply.fault))}")
        return reply

    def identify(self, tries: int = TRIES) -> Identity:
        """Ask who is there; WorkError for what is no Station device or speaks another protocol.

        Takes the device to idle, motor at zero, should a run of another host be on.
        """
        self.session = self.decoder.session = 0
        found, self._seen = None, 0
        for self._tries in range(1, tries + 1):
            nonce = secrets.randbits(16)
            frame = encode(MESSAGES["identify"].pack(version=PROTOCOL.version, hash=PROTOCOL.hash, nonce=nonce))
            found = self._once(b"\0" + frame, functools.partial(self._identity, nonce=nonce))
            if found is not None:
                break
        else:
            raise self._no_station(self._seen)
        self.inbox.clear()  # the rest is of an earlier connection
        self._challenge = found.challenge
        self.paced = not found.flags & BoardFlags.VIRTUAL_TIME
        self._limits = DeviceLimits(found.travel_limit, found.speed_limit, found.stall_command, found.stall_time)
        reset = Reset(found.reset) if found.reset in Reset._value2member_map_ else found.reset
        return Identity(found.board, found.build, found.boot, found.zeroings, found.clock_hz,
                        found.rate_min / 1000.0, found.rate_max / 1000.0, found.command_limit,
                        bool(found.flags & BoardFlags.VIRTUAL_TIME), reset, State(found.state), self._limits,
                        found.baud_rate, found.allowance * 1e-6)

    def configure(self, rate: float, command_limit: int, hold_ticks: int | None = None,
                  fault_ticks: int | None = None, answer_ticks: int = 1, limits: DeviceLimits | None = None) -> None:
        """Set rate (Hz) and limits; by default hold 1 tick, fault after 10 ticks or 50 ms, the shorter.

        ``limits`` (``DeviceLimits.of_rig(rig)``) tighten the device's own and never loosen them.
        """
        longest = max(2, int(rate * LIMITS["fault_time_max_ms"] / 1000.0))
        fault_ticks = min(LIMITS["fault_ticks_default"], longest) if fault_ticks is None else fault_ticks
        hold_ticks = LIMITS["hold_ticks_default"] if hold_ticks is None else hold_ticks
        held = (limits or NO_LIMITS).within(self._limits)
        self._ask("configure", rate=round(rate * 1000.0), command_limit=command_limit, hold_ticks=hold_ticks,
                  fault_ticks=fault_ticks, answer_ticks=answer_ticks, travel_limit=held.travel,
                  speed_limit=held.speed, stall_command=held.stall_command, stall_time=held.stall_time)

    def arm(self) -> None:
        """Arm, with the challenge of the last identify."""
        self._ask("arm", challenge=self._challenge)

    def start(self) -> int:
        """Start a session under a new random number, which is returned; samples come from now on."""
        self.session = self.last_session = self.decoder.session = secrets.randbelow(0xFFFF) + 1
        reply = self._request("start", "reply", session=self.session, challenge=self._challenge)
        if reply.state != State.RUNNING:
            raise WorkError(f"{self.port.url}: the device refuses to start: "
                            f"it is {state_words(reply.state, reply.fault)}")
        return self.session

    def halt(self, next_index: int | None = None) -> bool:
        """Motor to zero and stop, on every way out: never raises for the line; whether the device confirmed."""
        try:
            zero = b""
            if self.session and next_index is not None:
                zero = encode(MESSAGES["command"].pack(index=next_index & 0xFFFF, command=0), self.session)
            self._request("stop", "reply", zero)
        except WorkError:
            return False
        self.session = self.decoder.session = 0
        return True

    def clear(self) -> None:
        """Leave a fault."""
        self._ask("clear")

    def zero(self) -> None:
        """Let the encoder read 0 where it stands."""
        self._ask("zero")

    def statistics(self) -> Any:
        """The device's counters since the last start."""
        return self._request("query", "statistics")

    def wait(self, seconds: float) -> None:
        """Let time pass, the device's own where that is virtual; frames that come are kept in ``inbox``."""
        for _ in range(max(1, round(seconds / TIMEOUT))):
            self.inbox.extend(self.decoder.feed(self.port.read(LIMITS["frame_bytes"] * 64)))

    def wait_for_rest(self, seconds: float = 10.0) -> int:
        """Wait until the encoder rests; returns its reading (counts).  WorkError where it still moves."""
        waited = 0.0
        while True:
            found = self.statistics()
            if not found.status & Status.MOVING:
                return found.encoder
            if waited >= seconds:
                raise WorkError(f"{self.port.url}: the arm still moves after {seconds:g} s (encoder "
                                f"{found.encoder}); let it come to rest")
            self.wait(TIMEOUT)
            waited += TIMEOUT


def state_words(state: int, fault: int) -> str:
    """A device's state for people."""
    if state == State.FAULT:
        reason = Fault(fault).name.lower().replace("_", " ") if fault in Fault._value2member_map_ else f"code {fault}"
        return f"in fault ({reason})"
    return State(state).name.lower() if state in State._value2member_map_ else f"in state {state}"


def decoded(body: bytes) -> tuple[str, Any]:
    """A body's message name and fields."""
    message = MESSAGE_OF_CODE[body[0]]
    return message.name, message.unpack(body)
