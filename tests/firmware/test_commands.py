"""What becomes of a command: latched for its tick, limited, refused; and what a silent host leads to."""

import pytest

from station.device.framing import encode
from station.device.protocol import MESSAGES, Fault, InputFlags, State, Status


def only(messages, name):
    return [fields for kind, fields in messages if kind == name]


def test_a_command_acts_from_its_tick_on_and_the_sample_says_so(bench):
    bench.start()
    assert bench.tick()[0] == 0
    for i in range(1, 50):
        bench.command(i, 10 + i)
        assert bench.core.drive == (9 + i if i > 1 else 0)  # not before its tick
        drive, messages = bench.tick()
        (sample,) = only(messages, "sample")
        assert drive == sample.command == 10 + i
        assert sample.index == i
        assert not sample.status & (Status.HELD | Status.ZEROED | Status.FAULT)
    assert bench.statistics().commands == 49


@pytest.mark.parametrize(("hold", "fault"), [(0, 1), (0, 2), (1, 2), (1, 10), (5, 6), (5, 25)])
def test_a_silent_host_is_held_then_zeroed_then_faulted_at_the_exact_ticks(bench, hold, fault):
    bench.start(hold_ticks=hold, fault_ticks=fault)
    bench.tick()
    bench.command(1, 120)
    assert bench.tick()[0] == 120
    for silent in range(1, fault + 5):
        drive, messages = bench.tick()
        assert drive == (120 if silent <= hold else 0)
        assert bench.core.state == (State.FAULT if silent >= fault else State.RUNNING)
        samples, faults = only(messages, "sample"), only(messages, "fault")
        assert len(samples) == (silent <= fault)
        assert len(faults) == (silent == fault)
        if samples:
            assert bool(samples[0].status & Status.HELD) == (silent <= hold)
            assert bool(samples[0].status & Status.ZEROED) == (silent > hold or silent == fault)
            assert bool(samples[0].status & Status.FAULT) == (silent == fault)
        if faults:
            assert faults[0].fault == Fault.HOST_SILENT
            assert faults[0].index == 1 + fault
    statistics = bench.statistics()
    assert statistics.held == hold
    assert statistics.held + statistics.zeroed == fault
    assert statistics.samples == 2 + fault


def test_a_host_that_never_answers_never_moves_the_motor(bench):
    bench.start()
    assert [bench.tick()[0] for _ in range(30)] == [0] * 30
    assert bench.core.state == State.FAULT


def test_a_fault_is_latched_and_left_by_clear_alone(bench):
    bench.start()
    for _ in range(12):
        bench.tick()
    bench.command(12, 100) if bench.core.running else None
    bench.ask("stop")
    bench.identify()
    assert bench.core.state == State.FAULT
    assert bench.ask("clear").state == State.IDLE
    bench.start(session=12)
    bench.tick()
    bench.command(1, 50)
    assert bench.tick()[0] == 50


@pytest.mark.parametrize("limit", [0, 1, 57, 200])
@pytest.mark.parametrize("command", [-32768, -32767, -201, -200, -57, 0, 57, 58, 200, 201, 32767])
def test_no_command_passes_the_limit(bench, limit, command):
    bench.start(command_limit=limit)
    bench.tick()
    bench.command(1, command)
    drive, messages = bench.tick()
    (sample,) = only(messages, "sample")
    assert drive == sample.command == max(-limit, min(limit, command))
    beyond = abs(command) > limit
    assert bool(sample.status & Status.SATURATED) == beyond
    assert bench.statistics().limited == beyond


def test_a_stop_is_at_once_and_what_comes_after_it_moves_nothing(bench):
    bench.start()
    bench.tick()
    bench.command(1, 100)
    bench.tick()
    bench.command(2, 100)
    bench.ask("stop")
    assert bench.core.drive == 0
    assert bench.tick() == (0, [])
    bench.command(3, 100)
    assert bench.tick() == (0, [])


@pytest.mark.parametrize(("offset", "counter", "bit"), [
    (-9, "out_of_window", 0), (-8, "late", Status.LATE), (-1, "late", Status.LATE), (1, "early", Status.EARLY),
    (8, "early", Status.EARLY), (9, "out_of_window", 0), (1000, "out_of_window", 0), (-30000, "out_of_window", 0)])
def test_an_index_counts_only_for_the_coming_tick_within_its_window(bench, offset, counter, bit):
    bench.start()
    coming = 20
    bench.tick()
    for i in range(1, coming):
        bench.command(i, 5)
        bench.tick()
    bench.command(coming + offset, 100)
    drive, messages = bench.tick()
    (sample,) = only(messages, "sample")
    assert drive == 5  # held
    assert sample.status & Status.HELD
    assert sample.status & (Status.LATE | Status.EARLY) == bit
    statistics = bench.statistics()._asdict()
    counters = ("late", "early", "repeated", "out_of_window")
    assert {name: statistics[name] for name in counters} == {name: int(name == counter) for name in counters}


def test_the_first_of_two_commands_for_a_tick_stands(bench):
    bench.start()
    bench.tick()
    bench.command(1, 30)
    bench.command(1, 90)
    drive, messages = bench.tick()
    assert drive == 30
    assert only(messages, "sample")[0].status & Status.REPEATED
    assert bench.statistics().repeated == 1


@pytest.mark.parametrize("answer_ticks", [1, 2, 3, 4])
def test_an_answer_may_take_as_many_ticks_as_was_configured(bench, answer_ticks):
    bench.start(answer_ticks=answer_ticks)
    drives = []
    for i in range(40):
        drive, messages = bench.tick()
        assert not only(messages, "sample")[0].status & (Status.HELD | Status.ZEROED)
        drives.append(drive)
        bench.command(i + answer_ticks, i + 1)
    assert drives == [0] * answer_ticks + list(range(1, 41 - answer_ticks))
    assert bench.statistics().early == 0


@pytest.mark.parametrize("answer_ticks", [1, 2, 4])
def test_before_its_sample_was_sent_no_command_is_taken(bench, answer_ticks):
    bench.start(answer_ticks=answer_ticks)
    for index in range(6):
        bench.command(index, 100)
    assert bench.statistics().early == 6
    assert bench.tick()[0] == 0


def test_the_index_wraps(bench):
    bench.start()
    for i in range(65_540):
        drive, _ = bench.tick()
        assert drive == (0 if i == 0 else i % 150)
        bench.command(i + 1, (i + 1) % 150)
    statistics = bench.statistics()
    assert (statistics.samples, statistics.commands, statistics.held) == (65_540, 65_540, 0)


def test_commands_of_another_session_do_not_pass(bench):
    bench.start(session=1000)
    bench.tick()
    for other in (1, 999, 1001, 0xFFFF):
        bench.core.receive(encode(MESSAGES["command"].pack(index=1, command=100), other))
    bench.core.receive(encode(MESSAGES["command"].pack(index=1, command=100), 0))
    assert bench.tick()[0] == 0
    assert bench.statistics().corrupt == 5


def test_a_whole_recorded_line_delivered_again_moves_nothing(bench):
    bench.start(session=1000)
    for i in range(8):
        bench.tick()
        bench.command(i + 1, 150)
    bench.ask("stop")
    recorded = bench.sent
    for _ in range(3):
        for at in range(0, len(recorded), 9):
            bench.core.receive(recorded[at:at + 9])
            drive, _ = bench.tick()
            assert drive == 0
    assert bench.core.state == State.IDLE


def test_a_recorded_line_does_not_move_a_session_started_since(bench):
    bench.start(session=1000)
    for i in range(8):
        bench.tick()
        bench.command(i + 1, 150)
    commands = bench.sent[-9 * 8:]
    bench.ask("stop")
    bench.start(session=2000)
    for at in range(8):
        bench.core.receive(commands[9 * at:9 * at + 9])
        assert bench.tick()[0] == 0


def test_a_tick_that_began_late_says_so_and_is_counted(bench):
    bench.start()
    _, messages = bench.tick(flags=int(InputFlags.WOKE_LATE))
    assert only(messages, "sample")[0].status & Status.WOKE_LATE
    _, messages = bench.tick()
    assert not only(messages, "sample")[0].status & Status.WOKE_LATE
    assert bench.statistics().woke_late == 1


def test_a_line_that_nobody_reads_costs_samples_and_counts_them(bench):
    bench.start()
    for i in range(20):
        bench.core.tick(i, 0, 0)
        bench.core.receive(encode(MESSAGES["command"].pack(index=i + 1, command=10), bench.session))
    received = len(bench.heard())
    statistics = bench.statistics()
    assert received == 256 // 22
    assert statistics.samples == received
    assert statistics.unsent_samples == statistics.unsent_frames == 20 - received


def test_silence_of_an_earlier_session_does_not_count(bench):
    bench.start(session=1)
    for _ in range(8):
        bench.tick()
    bench.ask("stop")
    bench.start(session=2)
    states = []
    for _ in range(11):
        bench.tick()
        states.append(bench.core.state)
    assert states == [State.RUNNING] * 10 + [State.FAULT]


@pytest.mark.parametrize("more", [b"\0", b"\1", b"\1\2\3"])
def test_a_command_of_another_length_is_refused_even_with_its_crc_right(bench, more):
    bench.start()
    bench.tick()
    body = MESSAGES["command"].pack(index=1, command=100)
    bench.core.receive(encode(body + more, bench.session) + encode(body[:-1], bench.session))
    assert bench.tick()[0] == 0
    assert bench.statistics().corrupt == 2


def test_commands_of_session_zero_before_a_start_are_gone_when_it_comes(bench):
    bench.arm()
    for state in ("idle", "armed"):
        if state == "idle":
            bench.ask("stop")
        for index in range(8):
            bench.core.receive(encode(MESSAGES["command"].pack(index=index, command=100), 0))
        assert bench.statistics().corrupt == 8
        bench.start()
        assert [bench.tick()[0] for _ in range(5)] == [0] * 5
        bench.ask("stop")


def test_an_answer_that_is_always_one_tick_behind_ends_in_fault(bench):
    """As when the board ticks at twice the rate that the host keeps up with."""
    bench.start(hold_ticks=1, fault_ticks=10)
    drives = []
    for i in range(14):
        drives.append(bench.tick()[0])
        bench.core.receive(encode(MESSAGES["command"].pack(index=i, command=100), bench.session))
    assert drives == [0] * 14
    assert bench.core.state == State.FAULT
    statistics = bench.statistics()
    assert (statistics.late, statistics.held, statistics.zeroed, statistics.corrupt) == (10, 1, 9, 4)


def test_the_transmit_buffer_is_used_to_its_last_byte_and_not_beyond(bench):
    arm = encode(MESSAGES["arm"].pack(challenge=0))
    bench.start()
    for _ in range(3):
        bench.core.tick(0, 0, 0)
    bench.core.receive(encode(MESSAGES["query"].pack()) + arm * 7)
    assert bench.core.waiting == 3 * 22 + 78 + 7 * 16 == 256
    bench.core.receive(arm)
    assert bench.core.waiting == 256
    assert len(bench.heard()) == 11
    assert bench.statistics().unsent_frames == 1


def test_a_frame_that_would_only_fit_without_its_check_is_refused(bench):
    bench.start()
    for _ in range(3):
        bench.core.tick(0, 0, 0)
    bench.core.receive(encode(MESSAGES["arm"].pack(challenge=0)) * 12)
    assert bench.core.waiting == 3 * 22 + 11 * 16 == 242
    assert len(bench.heard()) == 14


def test_a_line_that_takes_a_few_bytes_at_a_time_gets_them_all_in_order(bench):
    bench.start()
    for _ in range(3):
        bench.core.tick(0, 0, 0)
    data = b"".join(bench.core.transmit(5) for _ in range(14))
    assert [body[0] for body in bench.decoder.feed(data)] == [MESSAGES["sample"].code] * 3
    assert bench.core.transmit() == b""


@pytest.mark.parametrize("command", [51, -51])
def test_a_motion_seen_by_the_encoder_ends_a_stall_and_a_small_command_is_none(bench, command):
    bench.start(stall_command=50, stall_time=20)  # 10 ticks
    bench.tick()
    for i in range(1, 60):
        bench.command(i, 60)
        bench.tick(encoder=2 * (i // 8))
    assert bench.core.running
    for i in range(60, 90):
        bench.command(i, 50)
        bench.tick()
    assert bench.core.running
    for i in range(90, 102):
        assert bench.core.running
        bench.command(i, command)
        bench.tick(encoder=14 + i % 2)
    assert bench.statistics().fault == Fault.STALLED


def test_speed_is_watched_from_before_the_session_on_and_across_the_wrap(bench):
    for i in range(12):
        bench.tick(encoder=2**31 - 20 + 10 * i - (2**32 if 10 * i >= 20 else 0))
    bench.start(speed_limit=79)
    bench.tick(encoder=-(2**31) + 100)
    assert bench.statistics().fault == Fault.SPEED


def test_a_zeroing_is_no_motion(bench):
    for _ in range(120):
        bench.tick(encoder=5000)
    bench.ask("zero")
    bench.start(speed_limit=5, travel_limit=5)
    for i in range(20):
        bench.tick()
        bench.command(i + 1, 1)
    assert bench.core.running


def test_the_enable_pin_is_active_in_a_session_alone(bench):
    assert not bench.core.enabled
    bench.start()
    assert bench.core.enabled
    bench.ask("stop")
    assert not bench.core.enabled
    bench.start()
    for _ in range(12):
        bench.tick()
    assert bench.core.state == State.FAULT and not bench.core.enabled


def test_a_command_ends_the_silence(bench):
    bench.start(hold_ticks=1, fault_ticks=3)
    bench.tick()
    for i in range(1, 40):
        if i % 2:
            bench.command(i, 70)
        assert bench.tick()[0] == 70
    assert bench.statistics().held == 19
