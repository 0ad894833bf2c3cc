"""The state machine: every request in every state, and what a start needs."""

import pytest

from station.device.protocol import PROTOCOL, Result, State, Status
from tests.firmware.conftest import CONFIGURE

IDLE, ARMED, RUNNING, FAULT = State.IDLE, State.ARMED, State.RUNNING, State.FAULT
NO = Result.WRONG_STATE


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
    identity = bench.ask("identify", version=version, hash=number)
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
