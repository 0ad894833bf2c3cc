"""What the board does is what firmware/states.toml says: each event in each state, its counter and its fault."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from station.device.firmware import firmware_folder
from station.device.framing import encode
from station.device.protocol import LIMITS, MESSAGES, PROTOCOL, Fault, InputFlags, Result, State
from station.device.states import EVENTS, NO_STATE, counters, markdown, read_states
from tests.firmware.conftest import CONFIGURE, LIMIT, Bench

RATE = 200_000
PER_SECOND = RATE // 1000
ARMED_TICKS = PER_SECOND * LIMITS["armed_time_ms"] // 1000
REST_TICKS = PER_SECOND * LIMITS["rest_time_ms"] // 1000
TEXT = (firmware_folder() / "states.toml").read_text(encoding="utf-8")
UNTOLD = {"samples", "unsent_samples", "unsent_frames"}
"""Counters of what is sent, which no event of the table moves."""


class Table(RuleBasedStateMachine):
    """A board played from the table, beside the core."""

    @initialize()
    def begin(self):
        self.bench = Bench(rate=RATE)
        self.state, self.fault = "idle", "none"
        self.counts = dict.fromkeys(counters(), 0)
        self.trusted = self.configured = self.spent = self.estop = False
        self.config = dict(CONFIGURE)
        self.encoder, self.past, self.rest, self.rest_encoder = 0, [], 0, 0
        self.session, self.seen = 0, set()

    def happen(self, name):
        """One event by the table."""
        event, before = EVENTS[name], self.state
        self.seen.add((name, before))
        if counter := event.counter_in(before):
            self.counts[counter] += 1
        if fault := event.fault_in(before):
            self.fault = fault
            self.counts["faults"] += 1
        if event.cells[before] not in NO_STATE:
            self.state = event.cells[before]

    def request(self, name, refusal=Result.OK, **values):
        """Ask; the table says what must come back where nothing else speaks against it."""
        refused = EVENTS[name].cells[self.state] == "refused"
        wanted = Result.WRONG_STATE if refused else refusal
        if name == "start" and wanted == Result.OK:
            self.counts = dict.fromkeys(self.counts, 0)
        if wanted in (Result.OK, Result.WRONG_STATE):
            self.happen(name)
        else:
            self.counts["refused"] += 1
        reply = self.bench.say(name, **values)[-1][1]
        assert (reply.result, reply.state) == (wanted, State[self.state.upper()])
        return wanted == Result.OK

    @rule()
    def identify(self):
        self.happen("identify")
        self.challenge = self.bench.identify().challenge
        self.trusted, self.configured, self.spent = True, False, False

    @rule(limits=st.sampled_from([{}, {"travel_limit": 20}, {"speed_limit": 60},
                                  {"stall_command": 50, "stall_time": 30}, {"command_limit": LIMIT + 1}]),
          hold=st.integers(0, 2))
    def configure(self, limits, hold):
        wanted = CONFIGURE | {"rate": RATE, "hold_ticks": hold, "fault_ticks": 4} | limits
        refusal = (Result.WRONG_PROTOCOL if not self.trusted else
                   Result.OUT_OF_RANGE if wanted["command_limit"] > LIMIT else Result.OK)
        if self.request("configure", refusal, **wanted):
            self.configured, self.config = True, wanted

    @rule(right=st.booleans())
    def arm(self, right):
        challenge = getattr(self, "challenge", 0) ^ (not right)
        refusal = (Result.NOT_CONFIGURED if not self.configured else Result.STALE if not right or
                   (self.spent and self.state != "armed") else Result.OK)
        before = self.state
        if self.request("arm", refusal, challenge=challenge) and before == "idle":
            self.spent, self.armed = True, 0

    @rule(right=st.booleans(), session=st.sampled_from([0, 1, 7, 0xFFFF]))
    def start(self, right, session):
        challenge = getattr(self, "challenge", 0) ^ (not right)
        refusal = Result.OUT_OF_RANGE if session == 0 else Result.OK if right else Result.STALE
        if self.request("start", refusal, session=session, challenge=challenge):
            self.configured, self.session, self.bench.session = False, session, session
            self.bench.decoder.session = session
            self.tick_number = self.silent = self.stalled = self.drive = 0
            self.slot = None

    @rule()
    def ready(self):
        """On the way to a run, from wherever."""
        if self.state == "fault":
            self.clear()
        self.identify()
        self.configure({}, 1)
        self.arm(True)

    @rule(limits=st.sampled_from([{"travel_limit": 20}, {"speed_limit": 60}, {"stall_command": 50, "stall_time": 30}]))
    def running(self, limits):
        """A run with a limit."""
        if self.state == "fault":
            self.clear()
        if self.state != "fault":
            self.identify()
            self.configure(limits, 1)
            self.arm(True)
            self.start(True, 7)
            self.tick()

    @rule()
    def stop(self):
        self.request("stop")

    @rule()
    def clear(self):
        if self.request("clear", Result.ESTOP_OPEN if self.estop else Result.OK):
            self.fault = "none"

    @rule()
    def zero(self):
        if self.request("zero", Result.MOVING if self.rest < REST_TICKS else Result.OK):
            self.encoder, self.past, self.rest_encoder = 0, [], 0

    @rule()
    def query(self):
        self.happen("query")
        found = self.bench.statistics()
        assert (found.state, found.fault) == (State[self.state.upper()], Fault[self.fault.upper()])

    @rule(ahead=st.integers(-10, 10), command=st.integers(-300, 300))
    def command(self, ahead, command):
        index = getattr(self, "tick_number", 0) + ahead
        self.bench.core.receive(encode(MESSAGES["command"].pack(index=index & 0xFFFF, command=command), self.session))
        if self.state != "running":
            self.happen("command")
        elif abs(ahead) > LIMITS["index_window"]:
            self.happen("out_of_window")
        elif ahead < 0:
            self.happen("late")
        elif ahead > 0 or self.tick_number == 0:
            self.happen("early")
        elif self.slot is not None:
            self.happen("repeated")
        else:
            self.happen("command")
            limit = self.config["command_limit"]
            self.slot = max(-limit, min(limit, command))
            self.counts["limited"] += abs(command) > limit

    @rule(data=st.binary(min_size=1, max_size=20))
    def garbage(self, data):
        data = data.replace(b"\0", b"\1")
        self.bench.core.receive(b"\0" + data + b"\0")
        self.happen("corrupt")

    @rule(flags=st.sampled_from([0, 0, 0, *InputFlags]), move=st.sampled_from([0, 0, 1, -30, 90]))
    def tick(self, flags=0, move=0):
        """One tick: the events of the board, of motion and of the host, in this order."""
        session_tick = self.state == "running"
        self.encoder += move
        self.rest = 0 if abs(self.encoder - self.rest_encoder) > 1 else min(self.rest + 1, REST_TICKS)
        self.rest_encoder = self.encoder if self.rest == 0 else self.rest_encoder
        self.past = [*self.past, self.encoder][-LIMITS["speed_ticks"] - 1:]
        if self.state == "armed":
            self.armed += 1
            if self.armed > ARMED_TICKS:
                self.happen("expire")
        self.estop = bool(flags & InputFlags.ESTOP)
        for flag, name in ((InputFlags.ESTOP, "estop"), (InputFlags.OVERRUN, "overrun"),
                           (InputFlags.HOST_GONE, "host_gone"), (InputFlags.WOKE_LATE, "woke_late")):
            if flags & flag:
                self.happen(name)
        self.configured = self.configured and not flags & InputFlags.HOST_GONE
        if self.state == "running":
            self.motion()
        if self.state == "running":
            self.host()
        if session_tick:
            self.tick_number += 1
            self.counts["samples"] += 1
        if self.state != "running":
            self.drive = 0
        drive, _ = self.bench.tick(self.bench.encoder + move, flags=int(flags))
        assert drive == self.drive

    def motion(self):
        config = self.config
        if self.tick_number == 0:
            self.origin = self.still = self.encoder
        moved = abs(self.encoder - self.still) > LIMITS["stall_counts"]
        if moved or abs(self.drive) <= config["stall_command"]:
            self.still, self.stalled = self.encoder, 0
        else:
            self.stalled += 1
        if config["travel_limit"] and abs(self.encoder - self.origin) > config["travel_limit"]:
            self.happen("travel")
        if config["speed_limit"] and abs(self.encoder - self.past[0]) > config["speed_limit"]:
            self.happen("speed")
        if config["stall_command"] and self.stalled > PER_SECOND * config["stall_time"] // 1000:
            self.happen("stalled")

    def host(self):
        if self.slot is not None:
            self.drive, self.slot, self.silent = self.slot, None, 0
        elif self.tick_number > 0:
            self.silent += 1
            if self.silent >= self.config["fault_ticks"]:
                self.happen("host_silent")
            elif self.silent > self.config["hold_ticks"]:
                self.happen("zeroed")
                self.drive = 0
            else:
                self.happen("held")

    @rule(count=st.integers(1, 12), command=st.sampled_from([0, 40, 60, -260]))
    def answered_ticks(self, count, command):
        for _ in range(count):
            self.command(0, command)
            self.tick()

    @rule(count=st.sampled_from([3, REST_TICKS, ARMED_TICKS + 1]))
    def ticks(self, count):
        for _ in range(count):
            self.tick()

    @invariant()
    def the_core_is_where_the_table_says(self):
        core = self.bench.core
        assert core.state == State[self.state.upper()]
        assert core.enabled == (self.state == "running")
        found = self.bench.statistics()._asdict()
        assert found["fault"] == Fault[self.fault.upper()]
        assert {name: found[name] for name in self.counts} == self.counts

    drive = 0


Table.TestCase.settings = settings(max_examples=150, stateful_step_count=30, deadline=None)
TestTable = Table.TestCase


@pytest.mark.parametrize("state", list(PROTOCOL.enums["state"]))
@pytest.mark.parametrize("name", list(EVENTS))
def test_each_cell(name, state):
    """Every cell of the table once, not left to chance."""
    board = Table()
    board.begin()
    config = {"travel": {"travel_limit": 20}, "speed": {"speed_limit": 60},
              "stalled": {"stall_command": 50, "stall_time": 30}}.get(name, {})
    for _ in range(REST_TICKS):
        board.tick()
    board.identify()
    if state != "idle":
        board.configure(config, 1)
        board.arm(True)
    if state in ("running", "fault"):
        board.start(True, 7)
        board.tick()
        board.command(0, 60)
        board.tick()
    if state == "fault":
        board.tick(InputFlags.OVERRUN)
    assert board.state == state
    board.seen.clear()
    if name in ("configure", "arm") and state == "idle":
        board.configure({}, 1)
    if name == "host_silent":
        board.ticks(4)
    elif name == "zeroed":
        board.ticks(2)
    elif name in ("late", "early", "out_of_window"):
        board.command({"late": -1, "early": 1, "out_of_window": 9}[name], 10)
    elif name == "repeated":
        board.command(0, 10)
        board.command(0, 10)
    elif name == "stalled":
        board.answered_ticks(9, 60)
    elif name == "expire":
        board.ticks(ARMED_TICKS + 1)
    else:
        {"identify": board.identify, "configure": lambda: board.configure({}, 1), "arm": lambda: board.arm(True),
         "start": lambda: board.start(True, 7), "command": lambda: board.command(0, 10), "stop": board.stop,
         "clear": board.clear, "zero": board.zero, "query": board.query, "corrupt": lambda: board.garbage(b"\1\2"),
         "held": board.tick, "travel": lambda: board.tick(0, 30), "speed": lambda: board.tick(0, 90),
         "overrun": lambda: board.tick(InputFlags.OVERRUN), "estop": lambda: board.tick(InputFlags.ESTOP),
         "host_gone": lambda: board.tick(InputFlags.HOST_GONE),
         "woke_late": lambda: board.tick(InputFlags.WOKE_LATE)}[name]()
    foreign = EVENTS[name].cells[state] == "foreign"
    assert foreign or EVENTS[name].cells[state] == "never" or (name, state) in board.seen
    board.the_core_is_where_the_table_says()


def test_the_docs_show_the_table_that_holds():
    docs = firmware_folder().parent / "docs" / "firmware.md"
    assert markdown() in docs.read_text(encoding="utf-8"), "python -c 'from station.device.states import ...markdown'"


@pytest.mark.parametrize(("old", "new", "words"), [
    ('name = "stop"', 'name = "halt"', "order"), ('fault = "travel"', 'fault = "far"', "no fault far"),
    ('counter = "late"', 'counter = "tardy"', "no counter tardy"), ('fault = "speed"\n', "", "speed: a fault code"),
    ('idle = "idle", armed = "idle", running = "idle", fault = "fault"', 'idle = "idle"', "one cell for each state")])
def test_a_table_that_contradicts_itself_is_refused(old, new, words):
    assert old in TEXT
    with pytest.raises(ValueError, match=words):
        read_states(TEXT.replace(old, new, 1))
