"""Host and firmware over a line that drops, flips, repeats, splits, joins and stores bytes."""

import random

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from station.device.client import TRIES, Client
from station.device.core import Board, Core
from station.device.framing import encode
from station.device.port import Port
from station.device.protocol import MESSAGES, State
from station.errors import WorkError

SAMPLE, COMMAND = MESSAGES["sample"], MESSAGES["command"]
LIMIT = 150
STORED = 4096
READS = 40_000
"""A request waits for 0.3 s at most, five times; no host reads so often in a rule unless it hangs."""


class BadLine:
    """A pyserial-like line to a core of its own.  The board ticks when the host has nothing left to read."""

    def __init__(self, seed):
        self.core = Core(Board("bad line", 500_000, LIMIT, boot=9), entropy=seed + 1)
        self.faults = set()
        self.stored = b""
        self.reads = self.ticks = 0
        self.driven = []
        self._random = random.Random(seed)
        self._held = {"host": b"", "device": b""}
        self._bytes = b""

    def _spoiled(self, sender, data):
        for fault in sorted(self.faults):
            if not data or self._random.random() > 0.15:
                continue
            at = self._random.randrange(len(data))
            if fault == "drop":
                data = data[:at] + data[at + self._random.randint(1, 20):]
            elif fault == "flip":
                data = data[:at] + bytes([data[at] ^ 1 << self._random.randrange(8)]) + data[at + 1:]
            elif fault == "repeat":
                data = data[:at] + data[at:] * 2
            elif fault == "split":
                data, self._held[sender] = self._held[sender] + data[:at], data[at:]
            elif fault == "join":
                data, self._held[sender] = b"", self._held[sender] + data
        if data and self._random.random() < 0.7:
            data, self._held[sender] = self._held[sender] + data, b""
        return data

    def write(self, data):
        self.stored = (self.stored + data)[-STORED:]
        self.core.receive(self._spoiled("host", data) if self.faults else self._held.pop("host", b"") + data)
        self._held.setdefault("host", b"")
        self._fetch()

    def _fetch(self):
        data = self.core.transmit()
        if self.faults:
            self._bytes += self._spoiled("device", data)
        else:
            self._bytes += self._held["device"] + data
            self._held["device"] = b""

    def tick(self):
        self.ticks += 1
        self.driven.append(self.core.tick(2000 * self.ticks, 0, 0))
        self._fetch()

    @property
    def in_waiting(self):
        return len(self._bytes)

    def read(self, size):
        self.reads += 1
        assert self.reads < READS, "the host hangs"
        for _ in range(50):  # 0.1 s of the board's time
            if self._bytes:
                break
            self.tick()
        data, self._bytes = self._bytes[:size], self._bytes[size:]
        return data

    def close(self):
        pass


class BothEnds(RuleBasedStateMachine):
    """A host that comes and goes; commands are 100 + the number of the session, so that each tells whose it is."""

    @initialize(seed=st.integers(0, 2**16))
    def begin(self, seed):
        self.line = BadLine(seed)
        self.client = Client(Port("bad", self.line))
        self.sessions = 0
        self.old = b""

    def exchange(self, ticks, stop=True):
        """A session of so many samples; whatever happens to it, it ends."""
        client, self.line.reads, self.started = self.client, 0, False
        self.sessions = self.sessions % 40 + 1
        try:
            if client.identify().state == State.FAULT:
                client.clear()
                client.identify()
            client.configure(500.0, LIMIT)
            client.arm()
            client.start()
            self.line.driven.clear()
            self.started = True
            for _ in range(ticks):
                bodies = [*client.inbox, *client.decoder.feed(self.line.read(SAMPLE.wire_size))]
                client.inbox.clear()
                for body in bodies:
                    if body[0] == SAMPLE.code:
                        frame = encode(COMMAND.pack(index=SAMPLE.unpack(body).index + 1 & 0xFFFF,
                                                    command=100 + self.sessions), client.session)
                        self.old = (self.old + frame)[-STORED:]
                        client.port.write(frame)
        except WorkError:
            return False
        finally:
            if stop:
                client.halt()
        return True

    @rule(faults=st.sets(st.sampled_from(["drop", "flip", "repeat", "split", "join"]), min_size=1),
          ticks=st.integers(1, 60), stop=st.booleans())
    def a_session_on_the_bad_line(self, faults, ticks, stop):
        self.line.faults = faults
        self.exchange(ticks, stop)
        assert not self.started or set(self.line.driven) <= {0, 100 + self.sessions}
        self.line.faults = set()

    @rule(ticks=st.integers(5, 60), stop=st.booleans())
    def a_session_on_a_good_line(self, ticks, stop):
        assert self.exchange(ticks, stop)
        assert 100 + self.sessions in self.line.driven
        assert set(self.line.driven) <= {0, 100 + self.sessions}

    @rule()
    def after_a_bad_line_two_frames_are_enough(self):
        self.line.reads = 0
        self.client.identify()
        assert self.client._tries <= 2 < TRIES

    @rule()
    def commands_of_an_ended_session_come_after_a_new_start(self):
        assert self.exchange(3, stop=False)
        old = self.old[:-3 * COMMAND.wire_size]
        self.line.driven.clear()
        for at in range(0, len(old), 10 * COMMAND.wire_size):
            self.line.core.receive(old[at:at + 10 * COMMAND.wire_size])
            self.line.tick()
        assert set(self.line.driven) <= {0, 100 + self.sessions}
        assert self.client.halt()

    @rule(pieces=st.integers(1, 600))
    def what_the_line_has_stored_comes_after_a_new_connection(self, pieces):
        """4 KiB of the host's own bytes, identify, arm and start among them, delivered once more."""
        stored = self.line.stored
        self.line.reads = 0
        self.client = Client(Port("bad", self.line))
        self.client.identify()
        self.line.driven.clear()
        for at in range(0, len(stored), pieces):
            self.line.core.receive(stored[at:at + pieces])
            self.line.tick()
        assert set(self.line.driven) <= {0}
        self.line.core.receive(b"\0")

    @rule(count=st.integers(1, 30))
    def time_passes(self, count):
        for _ in range(count):
            self.line.tick()

    @invariant()
    def the_drive_is_within_the_limit_and_off_outside_a_session(self):
        core = self.line.core
        assert abs(core.drive) <= LIMIT
        assert core.running or core.drive == 0
        assert core.enabled == core.running


BothEnds.TestCase.settings = settings(max_examples=40, stateful_step_count=12, deadline=None)
TestBothEnds = BothEnds.TestCase
