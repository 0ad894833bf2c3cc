"""The pure codec: round trips, any split of the stream, errors of the line, resynchronisation."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station.device.framing import Decoder, decode, encode
from station.device.protocol import LIMITS, MESSAGES

SESSION = 0x5A5A
SAMPLE = MESSAGES["sample"]
DEVICE_MESSAGES = [message for message in MESSAGES.values() if message.sender == "device"]


def values_of(message):
    parts = {}
    for field in message.fields:
        if field.text_size:
            parts[field.name] = st.text(st.characters(min_codepoint=33, max_codepoint=126),
                                        max_size=field.text_size).map(str.encode)
        else:
            bits, sign = int(field.type[1:]), field.type[0] == "i"
            low = -(1 << bits - 1) if sign else 0
            parts[field.name] = st.integers(low, low + (1 << bits) - 1)
    return st.fixed_dictionaries(parts)


bodies = st.sampled_from(list(MESSAGES.values())).flatmap(
    lambda message: values_of(message).map(lambda values: message.pack(**values)))


def frame_of(body):
    return encode(body, SESSION if body[0] in (SAMPLE.code, MESSAGES["command"].code) else 0)


@given(st.data())
def test_what_is_packed_is_unpacked(data):
    for message in MESSAGES.values():
        values = data.draw(values_of(message))
        body = message.pack(**values)
        assert len(body) == message.body_size
        back = message.unpack(body)._asdict()
        assert {key: value.encode() if isinstance(value, str) else value for key, value in back.items()} == values


@given(bodies)
def test_a_frame_has_one_zero_byte_and_its_length_is_its_messages(body):
    frame = frame_of(body)
    assert frame.index(0) == len(frame) - 1
    assert len(frame) == len(body) + 5 <= LIMITS["frame_bytes"]
    assert decode(frame[:-1], SESSION) == body


@given(st.lists(bodies, max_size=12), st.lists(st.integers(0, 600), max_size=20))
def test_any_split_of_the_stream_gives_the_same_frames(sent, cuts):
    stream = b"".join(frame_of(body) for body in sent)
    decoder = Decoder(SESSION)
    got, at = [], 0
    for cut in [*sorted(cut for cut in cuts if cut < len(stream)), len(stream)]:
        got += decoder.feed(stream[at:cut])
        at = cut
    assert got == sent
    assert decoder.corrupt == 0
    assert decoder.pending == 0


@given(st.binary(max_size=700), st.lists(st.integers(0, 700), max_size=20))
def test_garbage_gives_the_same_counts_however_it_is_split(stream, cuts):
    whole, pieces = Decoder(SESSION), Decoder(SESSION)
    expected, got, at = whole.feed(stream + b"\0"), [], 0
    for cut in [*sorted(cut for cut in cuts if cut < len(stream)), len(stream)]:
        got += pieces.feed(stream[at:cut])
        at = cut
    got += pieces.feed(b"\0")
    assert (got, pieces.corrupt) == (expected, whole.corrupt)


@given(st.binary(max_size=400), bodies)
def test_after_garbage_the_first_whole_frame_passes(garbage, body):
    decoder = Decoder(SESSION)
    assert decoder.feed(garbage + b"\0" + frame_of(body))[-1:] == [body]


@pytest.mark.parametrize("message", DEVICE_MESSAGES, ids=lambda message: message.name)
def test_every_one_bit_error_of_every_answer_is_rejected(message):
    values = {field.name: b"sflr" if field.text_size else 0x100 >> 8 * (field.type[1:] == "8")
              for field in message.fields}
    frame = frame_of(message.pack(**values))
    for at in range(len(frame) - 1):
        for bit in range(8):
            decoder = Decoder(SESSION)
            broken = frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1:]
            assert decoder.feed(broken) == []
            assert decoder.corrupt >= 1


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_a_sample_passes_in_its_own_session_alone(one, other):
    body = SAMPLE.pack(index=1, clock=2, encoder=3, accel=4, command=5, status=6)
    assert (decode(encode(body, one)[:-1], other) is not None) == (one == other)


@given(bodies, st.binary(min_size=1, max_size=5))
@settings(max_examples=50)
def test_a_frame_of_another_length_is_refused(body, more):
    if body[0] == MESSAGES["identity"].code:  # may be longer in another version; its fields tell
        return
    assert decode(encode(body + more, SESSION)[:-1], SESSION) is None
    assert decode(encode(body + more)[:-1], 0) is None


def test_a_stream_without_end_takes_no_memory_and_counts_once():
    decoder = Decoder()
    for _ in range(1000):
        decoder.feed(b"\1" * 1000)
        assert decoder.pending <= LIMITS["frame_bytes"] + 1000
    decoder.feed(b"\0")
    assert decoder.corrupt == 1


def test_a_frame_passes_under_the_seed_of_its_own_scope_alone():
    """A link frame sealed with a session's number, and a session's sealed with none, are corrupt."""
    for message in MESSAGES.values():
        body = bytes([message.code]) + bytes(range(1, message.body_size))
        for sealed in (0, 4711, 4712):
            right = 4711 if message.in_session else 0
            assert decode(encode(body, sealed)[:-1], 4711) == (body if sealed == right else None), message.name
