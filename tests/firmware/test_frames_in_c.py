"""The core's own framing against the Python side and against faults of the line."""

from binascii import crc_hqx

import pytest
from cobs import cobs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from station.device.core import library
from station.device.framing import encode
from station.device.protocol import MESSAGES, PROTOCOL, State
from tests.firmware.conftest import CONFIGURE

EXAMPLES = {
    "identify": {"version": PROTOCOL.version, "hash": PROTOCOL.hash, "nonce": 0x0102},
    "configure": CONFIGURE,
    "arm": {"challenge": 0x12003400}, "start": {"session": 0x0100, "challenge": 0x12003400},
    "stop": {}, "clear": {}, "zero": {}, "query": {},
    "command": {"index": 300, "command": -150},
}


@given(data=st.binary(max_size=124), start=st.integers(0, 0xFFFF))
def test_the_crc_is_that_of_the_standard_library(data, start):
    _, lib = library()
    assert lib.station_crc(start, data, len(data)) == crc_hqx(data, start)


@given(body=st.binary(min_size=1, max_size=123), session=st.integers(0, 0xFFFF))
def test_both_sides_write_the_same_frame(body, session):
    ffi, lib = library()
    wire = ffi.new("uint8_t[]", 256)
    length = lib.station_encode(body, len(body), session, wire)
    assert bytes(ffi.buffer(wire, length)) == encode(body, session)
    assert lib.station_decode(wire, length - 1, session ^ 1) == 0
    wire[0:length] = encode(body, session)
    assert lib.station_decode(wire, length - 1, session) == len(body)
    assert bytes(ffi.buffer(wire, len(body))) == body


@given(frame=st.lists(st.integers(1, 255), min_size=1, max_size=127).map(bytes))
def test_both_sides_undo_or_refuse_the_same_stuffing(frame):
    ffi, lib = library()
    raw = ffi.new("uint8_t[]", frame)
    length = lib.station_unstuff(raw, len(frame))
    try:
        expected = cobs.decode(frame)
    except cobs.DecodeError:
        expected = b""
    assert bytes(ffi.buffer(raw, length)) == expected


@st.composite
def messages(draw):
    message = draw(st.sampled_from([m for m in MESSAGES.values() if m.fields]))
    values = {}
    for field in message.fields:
        if field.text_size:
            values[field.name] = draw(st.binary(max_size=field.text_size).map(lambda b: b.replace(b"\0", b"x")))
        else:
            bits, sign = int(field.type[1:]), field.type[0] == "i"
            low = -(1 << bits - 1) if sign else 0
            values[field.name] = draw(st.integers(low, low + (1 << bits) - 1))
    return message, values


@given(messages())
@settings(max_examples=300)
def test_both_sides_pack_and_unpack_every_message_alike(drawn):
    message, values = drawn
    ffi, lib = library()
    fields = ffi.new(f"station_{message.name} *", values)
    body = ffi.new("uint8_t[]", message.body_size)
    getattr(lib, f"station_pack_{message.name}")(fields, body)
    packed = bytes(ffi.buffer(body))
    assert packed == message.pack(**values)
    back = ffi.new(f"station_{message.name} *")
    getattr(lib, f"station_unpack_{message.name}")(packed, back)
    for field in message.fields:
        value = getattr(back, field.name)
        assert (ffi.string(value) if field.text_size else value) == values[field.name]


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_one_bit_error_of_every_request_is_rejected(make_bench, name):
    bench = make_bench()
    bench.start(session=0x5A5A)
    frame = encode(MESSAGES[name].pack(**EXAMPLES[name]), bench.session if name == "command" else 0)
    for at in range(len(frame) - 1):
        for bit in range(8):
            broken = frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1:]
            bench.core.receive(b"\0" + broken + b"\0")
            assert bench.heard() == []
            assert bench.core.state == State.RUNNING
    assert bench.statistics().commands == 0
    bench.core.receive(frame)
    assert bench.heard() or bench.statistics().early + bench.statistics().out_of_window == 1


@given(st.binary(max_size=600))
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_garbage_moves_nothing_and_the_next_frame_passes(make_bench, data):
    bench = make_bench()
    bench.start(session=0x5A5A)
    bench.tick()
    bench.core.receive(data + b"\0")
    bench.heard()
    assert bench.core.state == State.RUNNING
    bench.command(1, 33)
    assert bench.tick()[0] == 33


@pytest.mark.parametrize("length", [126, 127, 128, 129, 500])
def test_a_frame_longer_than_any_is_one_corrupt_frame(bench, length):
    bench.core.receive(b"\1" * length + b"\0")
    assert bench.statistics().corrupt == 1
    assert bench.identify().state == State.IDLE


@pytest.mark.parametrize("length", [127, 128, 129, 300])
def test_a_frame_longer_than_any_leaves_what_waits_for_the_line_alone(bench, length):
    bench.core.receive(encode(MESSAGES["query"].pack()) + b"\7" * length + b"\0")
    assert [name for name, _ in bench.heard()] == ["statistics"]


@pytest.mark.parametrize("length", range(1, 20))
def test_a_count_beyond_the_frames_end_is_refused(length):
    ffi, lib = library()
    for beyond in (1, 2, 3):
        raw = ffi.new("uint8_t[]", bytes([length + beyond] + [1] * (length - 1) + [1, 1, 1, 1]))
        assert lib.station_unstuff(raw, length) == 0
    assert lib.station_unstuff(ffi.new("uint8_t[]", bytes([length] + [1] * (length - 1))), length) == length - 1
