"""The state machine: every request in every state, and what a start needs."""

import pytest

from station.device.limits import DeviceLimits
from station.device.protocol import LIMITS, PROTOCOL, Fault, InputFlags, Result, State, Status
from tests.firmware.conftest import CONFIGURE, RATE

IDLE, ARMED, RUNNING, FAULT = State.IDLE, State.ARMED, State.RUNNING, State.FAULT
NO = Result.WRONG_STATE
ARMED_TICKS = RATE // 1000 * LIMITS["armed_time_ms"] // 1000


def bring(bench, state):
    """Take a fresh core to a state; returns the challenge that holds there."""
    if state == IDLE:
        challenge = bench.identify().challenge
        assert bench.configure().result == Result.OK
        for _ in range(101):  # at rest, so that zero is refused for the state alone
            bench.tick()
        return challenge
    challenge = bring(bench, IDLE)
    bench.ask("arm", challenge=challenge)
    if state in (RUNNING, FAULT):
        bench.ask("start", session=99, challenge=challenge)
        bench.session = bench.decoder.session = 99
        bench.tick()
    if state == FAULT:
        for _ in range(10):
            bench.tick()
    assert bench.core.state == state
    return challenge


EXPECTED = {  # request: (result, state after) for idle, armed, running, fault
    "configure": ((Result.OK, IDLE), (NO, ARMED), (NO, RUNNING), (NO, FAULT)),
    "arm": ((Result.OK, ARMED), (Result.OK, ARMED), (NO, RUNNING), (NO, FAULT)),
    "start": ((NO, IDLE), (Result.OK, RUNNING), (NO, RUNNING), (NO, FAULT)),
    "stop": ((Result.OK, IDLE), (Result.OK, IDLE), (Result.OK, IDLE), (Result.OK, FAULT)),
    "clear": ((Result.OK, IDLE), (NO, ARMED), (NO, RUNNING), (Result.OK, IDLE)),
    "zero": ((Result.OK, IDLE), (NO, ARMED), (NO, RUNNING), (NO, FAULT)),
}


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("request_name", EXPECTED)
def test_every_request_in_every_state(bench, request_name, state):
    challenge = bring(bench, state)
    values = {"configure": CONFIGURE, "arm": {"challenge": challenge},
              "start": {"session": 5, "challenge": challenge}}.get(request_name, {})
    reply = bench.ask(request_name, **values)
    assert (reply.result, reply.state) == EXPECTED[request_name][state]
    assert bench.core.state == reply.state


@pytest.mark.parametrize(("state", "after"), [(IDLE, IDLE), (ARMED, IDLE), (RUNNING, IDLE), (FAULT, FAULT)])
def test_identify_takes_the_line_and_the_motor_to_rest(bench, state, after):
    bring(bench, state)
    bench.command(1, 150) if state == RUNNING else None
    bench.tick()
    assert bench.identify().state == after
    assert bench.core.drive == 0


def test_arming_needs_a_configure_since_the_last_identify(bench):
    bench.arm()
    bench.ask("stop")
    challenge = bench.identify().challenge
    assert bench.ask("arm", challenge=challenge).result == Result.NOT_CONFIGURED


def test_each_run_needs_its_own_identify_and_configure(bench):
    bench.start()
    bench.ask("stop")
    assert bench.ask("arm", challenge=0).result == Result.NOT_CONFIGURED


def test_an_old_challenge_arms_nothing(bench):
    old = bench.identify().challenge
    new = bench.identify().challenge
    assert old != new
    bench.configure()
    assert bench.ask("arm", challenge=old).result == Result.STALE
    assert bench.core.state == IDLE


@pytest.mark.parametrize(("version", "number"), [(PROTOCOL.version + 1, PROTOCOL.hash),
                                                 (PROTOCOL.version, PROTOCOL.hash ^ 1)])
def test_a_host_of_another_protocol_is_told_who_we_are_and_refused(bench, version, number):
    identity = bench.ask("identify", version=version, hash=number, nonce=0)
    assert (identity.version, identity.hash) == (PROTOCOL.version, PROTOCOL.hash)
    assert bench.configure().result == Result.WRONG_PROTOCOL
    assert bench.ask("arm", challenge=identity.challenge).result == Result.NOT_CONFIGURED


@pytest.mark.parametrize("changes", [
    {"rate": 499_999}, {"rate": 500_001}, {"command_limit": 201}, {"command_limit": -1}, {"hold_ticks": 6},
    {"fault_ticks": 1}, {"fault_ticks": 26}, {"hold_ticks": 5, "fault_ticks": 5}, {"answer_ticks": 0},
    {"answer_ticks": 5}])
def test_configure_never_goes_beyond_what_is_compiled_in(bench, changes):
    bench.identify()
    assert bench.configure(**changes).result == Result.OUT_OF_RANGE
    assert bench.ask("arm", challenge=0).result == Result.NOT_CONFIGURED


@pytest.mark.parametrize("changes", [{"command_limit": 0}, {"hold_ticks": 0, "fault_ticks": 1}, {"hold_ticks": 5},
                                     {"fault_ticks": 25}, {"answer_ticks": 4}])
def test_configure_takes_the_bounds_themselves(bench, changes):
    bench.identify()
    assert bench.configure(**changes).result == Result.OK


def test_a_slow_device_may_wait_two_ticks_and_no_longer(make_bench):
    bench = make_bench(rate=20_000)
    bench.identify()
    assert bench.configure(rate=20_000, fault_ticks=2).result == Result.OK
    assert bench.configure(rate=20_000, fault_ticks=3).result == Result.OUT_OF_RANGE


def test_session_zero_is_no_session(bench):
    bench.arm()
    assert bench.ask("start", session=0, challenge=bench.challenge).result == Result.OUT_OF_RANGE
    assert bench.core.state == ARMED


def test_zeroing_is_refused_while_the_arm_moves_and_counted_when_done(bench):
    bench.identify()
    for i in range(200):
        bench.tick(encoder=1000 + 3 * i)
    assert bench.ask("zero").result == Result.MOVING
    for _ in range(101):
        bench.tick()
    assert bench.ask("zero").result == Result.OK
    assert bench.identify().zeroings == 1
    bench.tick()
    assert bench.statistics().encoder == 0
    bench.tick(encoder=bench.encoder - 5)
    assert bench.statistics().encoder == -5


def test_rest_is_known_after_200_ms_and_lost_with_the_second_count(bench):
    bench.arm()
    bench.ask("stop")
    moving = []
    for i in range(150):
        bench.tick(encoder=(i % 2) if i < 110 else 2)
        moving.append(bool(bench.statistics().status & Status.MOVING))
    assert moving == [i < 99 or i >= 110 for i in range(150)]


def test_the_encoder_counts_on_across_the_wrap_of_32_bits(bench):
    for _ in range(102):
        bench.tick(encoder=2**31 - 2)
    assert bench.ask("zero").result == Result.OK
    bench.tick(encoder=-(2**31) + 3)
    assert bench.statistics().encoder == 5


def test_armed_ends_by_itself_and_its_challenge_has_served(bench):
    bench.arm()
    challenge = bench.challenge
    for _ in range(ARMED_TICKS):
        bench.tick()
    assert bench.core.state == ARMED
    bench.tick()
    assert bench.core.state == IDLE
    assert bench.ask("start", session=5, challenge=challenge).result == NO
    assert bench.ask("arm", challenge=challenge).result == Result.STALE


def test_asking_twice_to_arm_gives_no_more_time(bench):
    bench.arm()
    for _ in range(ARMED_TICKS):
        bench.tick()
    assert bench.ask("arm", challenge=bench.challenge).result == Result.OK
    bench.tick()
    assert bench.core.state == IDLE


def test_a_program_that_did_not_arm_cannot_start_what_another_has_armed(bench):
    bench.arm()
    for challenge in (0, bench.challenge ^ 1, bench.challenge + 1 & 0xFFFFFFFF):
        assert bench.ask("start", session=5, challenge=challenge).result == Result.STALE
    assert bench.core.state == ARMED


def test_a_challenge_serves_once(bench):
    bench.start()
    bench.ask("stop")
    assert bench.configure().result == Result.OK
    assert bench.ask("arm", challenge=bench.challenge).result == Result.STALE


def test_the_time_at_which_a_host_asks_is_part_of_the_challenge(make_bench):
    challenges = set()
    for clock in range(20):
        bench = make_bench()
        bench.clock = 1000 * clock
        bench.tick()
        challenges.add(bench.identify().challenge)
    assert len(challenges) == 20


def test_no_two_challenges_of_a_power_up_are_alike(bench):
    assert len({bench.identify().challenge for _ in range(1000)}) == 1000


@pytest.mark.parametrize("own", [{}, {"limits": DeviceLimits(100, 50, 40, 30)}])
@pytest.mark.parametrize(("field", "value"), [("travel_limit", 100), ("speed_limit", 50), ("stall_command", 40),
                                              ("stall_time", 30)])
def test_configure_tightens_a_compiled_in_limit_and_never_loosens_it(make_bench, own, field, value):
    bench = make_bench(**own)
    bench.identify()
    rest = {"stall_command": 40, "stall_time": 30} if field.startswith("stall") else {}
    assert bench.configure(**rest | {field: value}).result == Result.OK
    assert bench.configure(**rest | {field: value - 1}).result == Result.OK
    assert bench.configure(**rest | {field: value + 1}).result == (Result.OUT_OF_RANGE if own else Result.OK)


def test_a_limit_that_is_not_configured_is_the_boards_own(make_bench):
    bench = make_bench(limits=DeviceLimits(travel=20))
    bench.start()
    bench.tick(0)
    bench.command(1, 10)
    bench.tick(20)
    assert bench.core.running
    bench.command(2, 10)
    assert bench.tick(21)[0] == 0
    assert bench.statistics().fault == Fault.TRAVEL


@pytest.mark.parametrize("limits", [{"stall_command": 40}, {"stall_time": 30}, {"stall_command": -1, "stall_time": 3}])
def test_a_stall_needs_a_level_and_a_time(bench, limits):
    bench.identify()
    assert bench.configure(**limits).result == Result.OUT_OF_RANGE


@pytest.mark.parametrize(("baud_rate", "allowance", "answer_ticks", "fits"), [
    (921_600, 500, 1, True), (230_400, 500, 1, True), (213_333, 500, 1, False), (213_440, 500, 1, True),
    (115_200, 500, 1, False), (115_200, 500, 2, True), (921_600, 2000, 1, False), (921_600, 2000, 2, True),
    (0, 2000, 1, True), (0, 2001, 1, False), (110_000, 500, 4, True), (109_999, 500, 4, False)])
def test_a_rate_that_the_line_cannot_hold_is_refused(make_bench, baud_rate, allowance, answer_ticks, fits):
    """32 bytes of 10 bits and the allowance within answer_ticks periods of 2 ms; the sample's 22 within one."""
    bench = make_bench(baud_rate=baud_rate, allowance=allowance)
    bench.identify()
    wanted = Result.OK if fits else Result.LINE_TOO_SLOW
    assert bench.configure(answer_ticks=answer_ticks).result == wanted


@pytest.mark.parametrize(("rate", "most"), [(20_000, 2), (39_999, 2), (40_000, 2), (60_000, 3), (100_000, 5),
                                            (500_000, 25)])
def test_fault_comes_within_50_ms_or_two_ticks_where_those_are_longer(make_bench, rate, most):
    bench = make_bench(rate=rate)
    bench.identify()
    assert bench.configure(rate=rate, fault_ticks=most).result == Result.OK
    assert bench.configure(rate=rate, fault_ticks=most + 1).result == Result.OUT_OF_RANGE
    assert bench.configure(rate=rate, fault_ticks=2).result == Result.OK


def test_an_open_estop_is_told_and_holds_the_fault_until_it_is_closed(bench):
    _, messages = bench.tick(flags=int(InputFlags.ESTOP))
    assert [(name, fields.fault) for name, fields in messages] == [("fault", Fault.ESTOP)]
    reply = bench.ask("clear")
    assert (reply.result, reply.state) == (Result.ESTOP_OPEN, FAULT)
    assert reply.status & Status.ESTOP
    bench.tick()
    assert bench.ask("clear").state == IDLE
    assert not bench.statistics().status & Status.ESTOP


def test_the_identity_tells_the_limits_and_the_line(make_bench):
    found = make_bench(limits=DeviceLimits(1000, 90, 80, 70), baud_rate=921_600, allowance=500).identify()
    assert (found.travel_limit, found.speed_limit, found.stall_command, found.stall_time) == (1000, 90, 80, 70)
    assert (found.baud_rate, found.allowance) == (921_600, 500)
