"""Frames on the wire: COBS, three bytes of check, one zero byte at the end.  No input or output here: bytes in, bytes
out.  firmware/protocol.toml says what the check is.
"""

from __future__ import annotations

from binascii import crc_hqx

from cobs import cobs

from station.device.protocol import LIMITS, MESSAGE_OF_CODE, MESSAGES

CRC_START = 0xFFFF
_FRAME_BYTES = LIMITS["frame_bytes"]
_CHECK_BYTES = LIMITS["check_bytes"]
_IDENTITY = MESSAGES["identity"].code
_IDENTITY_PREFIX = 7


def _check(crc: int) -> int:
    """The three bytes that carry a CRC, as one number."""
    return 0x404040 | (crc & 0xFC00) << 6 | (crc & 0x03E0) << 3 | crc & 0x1F


def encode(body: bytes, session: int = 0) -> bytes:
    """The frame of a body, delimiter included; ``session`` 0 for frames of scope "link"."""
    stuffed = cobs.encode(body)
    return stuffed + (_check(crc_hqx(stuffed, CRC_START ^ session)) << 8).to_bytes(4, "big")


def decode(frame: bytes, session: int = 0) -> bytes | None:
    """The body of a frame (without its delimiter), or None where COBS, check or length do not pass.

    The session number counts for messages of scope "session" alone.  An identity of another protocol version may
    have another length: its first two fields tell.
    """
    if len(frame) < _CHECK_BYTES + 2:
        return None
    message = MESSAGE_OF_CODE.get(frame[1])
    if message is None:
        return None
    stuffed = frame[:-_CHECK_BYTES]
    crc = crc_hqx(stuffed, CRC_START ^ session if message.in_session else CRC_START)
    if int.from_bytes(frame[-_CHECK_BYTES:], "big") != _check(crc):
        return None
    try:
        body = cobs.decode(stuffed)
    except cobs.DecodeError:
        return None
    if len(body) != message.body_size and (frame[1] != _IDENTITY or len(body) < _IDENTITY_PREFIX):
        return None
    return body if body[0] == message.code else None


def any_body(frame: bytes) -> bytes | None:
    """The body of a frame of scope "link" whose check passes, of whatever message and length; else None.

    For a device of another protocol: what it sends is not what this Station expects, but it is sent well.
    """
    stuffed = frame[:-_CHECK_BYTES]
    if len(stuffed) < 2 or int.from_bytes(frame[-_CHECK_BYTES:], "big") != _check(crc_hqx(stuffed, CRC_START)):
        return None
    try:
        return cobs.decode(stuffed) or None
    except cobs.DecodeError:
        return None


class Decoder:
    """Splits a stream into bodies, whatever pieces it comes in; counts the frames that do not pass.

    ``session`` is the number that frames of scope "session" must carry.  ``pending`` is the number of bytes of a
    frame whose end has not come.
    """

    def __init__(self, session: int = 0) -> None:
        self.session = session
        self.corrupt = 0
        self._rest = b""
        self._overlong = False

    @property
    def pending(self) -> int:
        """Bytes kept that belong to an unfinished frame."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[bytes]:
        """The bodies that these bytes complete, in their order."""
        if self._rest:
            data = self._rest + data
        *frames, self._rest = data.split(b"\0")
        bodies = []
        for frame in frames:
            overlong, self._overlong = self._overlong or len(frame) >= _FRAME_BYTES, False
            if not frame and not overlong:
                continue
            body = None if overlong else decode(frame, self.session)
            if body is None:
                self.corrupt += 1
            else:
                bodies.append(body)
        if len(self._rest) >= _FRAME_BYTES:
            self._rest, self._overlong = b"", True
        return bodies
