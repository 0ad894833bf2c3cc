"""Frames on the wire: COBS, CRC-16, one zero byte at the end.  No input or output here: bytes in, bytes out.

CRC-16 CCITT (``binascii.crc_hqx``) over the body, started at 0xFFFF XOR the session number, sent high byte first,
so that the CRC over body and CRC is 0.
"""

from __future__ import annotations

from binascii import crc_hqx

from cobs import cobs

from station.device.protocol import LIMITS, MESSAGE_OF_CODE, MESSAGES

CRC_START = 0xFFFF
_FRAME_BYTES = LIMITS["frame_bytes"]
_IDENTITY = MESSAGES["identity"].code
_IDENTITY_PREFIX = 7


def encode(body: bytes, session: int = 0) -> bytes:
    """The frame of a body, delimiter included; ``session`` 0 for frames of scope "link"."""
    return cobs.encode(body + crc_hqx(body, CRC_START ^ session).to_bytes(2, "big")) + b"\0"


def decode(frame: bytes, session: int = 0) -> bytes | None:
    """The body of a frame (without its delimiter), or None where COBS, CRC or length do not pass.

    The session number counts for messages of scope "session" alone.  An identity of another protocol version may
    have another length: its first two fields tell.
    """
    try:
        raw = cobs.decode(frame)
    except cobs.DecodeError:
        return None
    if len(raw) < 3:
        return None
    message = MESSAGE_OF_CODE.get(raw[0])
    if message is None:
        return None
    if len(raw) != message.body_size + 2 and (raw[0] != _IDENTITY or len(raw) < _IDENTITY_PREFIX + 2):
        return None
    if crc_hqx(raw, CRC_START ^ session if message.in_session else CRC_START):
        return None
    return raw[:-2]


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
