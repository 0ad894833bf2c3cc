"""A host that speaks with one firmware core directly, without a line between them."""

from __future__ import annotations

from typing import Any

import pytest

from station.device.core import Board, Core
from station.device.framing import Decoder, encode
from station.device.protocol import MESSAGE_OF_CODE, MESSAGES, PROTOCOL

RATE = 500_000
LIMIT = 200
CONFIGURE = {"rate": RATE, "command_limit": LIMIT, "hold_ticks": 1, "fault_ticks": 10, "answer_ticks": 1,
             "travel_limit": 0, "speed_limit": 0, "stall_command": 0, "stall_time": 0}


class Bench:
    """A core on the bench: requests in, answers out; ticks on demand."""

    def __init__(self, limit: int = LIMIT, rate: int = RATE, entropy: int = 12345, **board: Any) -> None:
        self.core = Core(Board("bench", rate, limit, boot=77, **board), entropy)
        self.decoder = Decoder()
        self.session = 0
        self.challenge = 0
        self.sent = b""
        self.encoder = 0
        self.clock = 0

    def say(self, name: str, **values: Any) -> list[tuple[str, Any]]:
        """Send one message; what comes back as (name, fields)."""
        message = MESSAGES[name]
        frame = encode(message.pack(**values), self.session if message.in_session else 0)
        self.sent += frame
        self.core.receive(frame)
        return self.heard()

    def ask(self, name: str, **values: Any) -> Any:
        """Send a request; its one answer."""
        (_, answer), = self.say(name, **values)
        return answer

    def heard(self) -> list[tuple[str, Any]]:
        return [(MESSAGE_OF_CODE[body[0]].name, MESSAGE_OF_CODE[body[0]].unpack(body))
                for body in self.decoder.feed(self.core.transmit())]

    def tick(self, encoder: int | None = None, accel: int = 0, flags: int = 0) -> tuple[int, list[tuple[str, Any]]]:
        """One tick: the drive, and what was sent."""
        self.encoder = self.encoder if encoder is None else encoder
        self.clock += 2000
        return self.core.tick(self.clock, self.encoder, accel, flags), self.heard()

    def configure(self, **changes: int) -> Any:
        return self.ask("configure", **(CONFIGURE | changes))

    def identify(self) -> Any:
        identity = self.ask("identify", version=PROTOCOL.version, hash=PROTOCOL.hash, nonce=self.clock & 0xFFFF)
        assert identity.nonce == self.clock & 0xFFFF
        self.challenge = identity.challenge
        return identity

    def arm(self, **changes: int) -> None:
        challenge = self.identify().challenge
        assert self.configure(**changes).result == 0
        assert self.ask("arm", challenge=challenge).result == 0

    def start(self, session: int = 4711, **changes: int) -> None:
        self.arm(**changes)
        assert self.ask("start", session=session, challenge=self.challenge).result == 0
        self.session = self.decoder.session = session

    def command(self, index: int, command: int) -> None:
        assert self.say("command", index=index & 0xFFFF, command=command) == []

    def statistics(self) -> Any:
        return self.ask("query")


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def make_bench() -> type[Bench]:
    return Bench
