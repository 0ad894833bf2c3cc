"""The core under any order of requests, commands, ticks and garbage: the motor is driven only as the rules allow."""

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from station.device.framing import encode
from station.device.protocol import MESSAGES, PROTOCOL, State
from tests.firmware.conftest import CONFIGURE, LIMIT, Bench


class AnyHost(RuleBasedStateMachine):
    """Keeps its own account of how long no command was taken and of the limit in force."""

    @initialize()
    def begin(self):
        self.bench = Bench()
        self.challenge, self.number, self.limit, self.hold, self.fault = 0, 0, LIMIT, 1, 10
        self.tick, self.silent, self.taken, self.driven = 0, 0, 0, 0

    def ask(self, name, **values):
        answers = self.bench.say(name, **values)
        return answers[-1][1] if answers else None

    @rule()
    def identify(self):
        self.challenge = self.ask("identify", version=PROTOCOL.version, hash=PROTOCOL.hash, nonce=1).challenge

    @rule(limit=st.integers(-5, LIMIT + 5), hold=st.integers(0, 7), fault=st.integers(0, 30), answer=st.just(1))
    def configure(self, limit, hold, fault, answer):
        reply = self.ask("configure", **(CONFIGURE | {"command_limit": limit, "hold_ticks": hold, "fault_ticks": fault,
                                                      "answer_ticks": answer}))
        if reply.result == 0:
            assert 0 <= limit <= LIMIT and hold <= 5 and hold < fault <= 25
            self.limit, self.hold, self.fault = limit, hold, fault

    @rule(right=st.booleans())
    def arm(self, right):
        self.ask("arm", challenge=self.challenge if right else self.challenge ^ 1)

    @rule(session=st.integers(0, 0xFFFF))
    def start(self, session):
        if self.ask("start", session=session, challenge=self.challenge).result == 0:
            self.bench.session = self.bench.decoder.session = session
            self.tick = self.silent = self.taken = self.driven = 0

    @rule(name=st.sampled_from(["stop", "clear", "zero", "query"]))
    def request(self, name):
        self.ask(name)

    @rule(ahead=st.integers(-12, 12), command=st.integers(-0x8000, 0x7FFF), right=st.booleans())
    def command(self, ahead, command, right):
        index = (self.tick + ahead) & 0xFFFF
        session = self.bench.session if right else self.bench.session ^ 1
        self.bench.core.receive(encode(MESSAGES["command"].pack(index=index, command=command), session))

    @rule(command=st.integers(-300, 300), count=st.integers(1, 30))
    def answered_ticks(self, command, count):
        for _ in range(count):
            self.command(0, command, True)
            self.one_tick()

    @rule(count=st.integers(1, 30))
    def ticks(self, count):
        for _ in range(count):
            self.one_tick()

    def one_tick(self):
        was_running = self.bench.core.running
        drive, messages = self.bench.tick()
        for name, fields in messages:
            if name == "sample":
                assert was_running and fields.index == self.tick & 0xFFFF and fields.command == drive
                self.tick += 1
        if not was_running:
            assert drive == 0
            return
        found = self.bench.ask("query")
        if self.tick > 1:
            self.silent = self.silent + 1 if found.held + found.zeroed > self.driven else 0
        self.driven = found.held + found.zeroed
        if self.silent > self.hold or self.tick == 1:
            assert drive == 0
        assert (self.bench.core.state == State.FAULT) == (self.silent >= self.fault)

    @rule(data=st.binary(max_size=200))
    def garbage(self, data):
        self.bench.core.receive(data + b"\0")
        self.bench.heard()

    @invariant()
    def the_drive_is_within_the_limit_and_zero_unless_running(self):
        core = self.bench.core
        assert abs(core.drive) <= self.limit
        assert core.running or core.drive == 0


AnyHost.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestAnyHost = AnyHost.TestCase
