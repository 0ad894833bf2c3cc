"""Frames on the wire: COBS, three bytes of check, one zero byte at the end.  No input or output here: bytes in, bytes
out.  firmware/protocol.toml says what the check is.
"""

from __future__ import annotations

from binascii import crc_hqx

from cobs import cobs

from station.device.protocol import LIMITS, MESSAGE_OF_CODE, MESSAGES

CRC_START = 0xFFFF
_FRAME_BYTES = LIMITS["frame_bytes"]
_stuff, _unstuff = cobs.encode, cobs.decode
_IDENTITY = MESSAGES["identity"].code
_IDENTITY_PREFIX = 7


def _tail(crc: int) -> bytes:
    """What follows the stuffed bytes, whose CRC is given: the check and the delimiter."""
    for salt in range(1, 256):
        rest = crc_hqx(bytes([salt]), crc)
        if rest > 0xFF and rest & 0xFF:
            break
    return bytes([salt, rest >> 8, rest & 0xFF, 0])


_TAILS = tuple(map(_tail, range(1 << 16)))
"""A table: frames are encoded and decoded within every sample period."""
_SESSION_SIZES, _LINK_SIZES = (
    tuple(MESSAGE_OF_CODE[code].body_size if code in MESSAGE_OF_CODE and MESSAGE_OF_CODE[code].in_session == in_session
          else 0 for code in range(256)) for in_session in (True, False))
"""Bytes of a body by its code: of scope "session", of scope "link"; 0: none."""
_STUFFED = slice(None, -LIMITS["check_bytes"])


def encode(body: bytes, session: int = 0) -> bytes:
    """The frame of a body, delimiter included; ``session`` 0 for frames of scope "link"."""
    stuffed = _stuff(body)
    return stuffed + _TAILS[crc_hqx(stuffed, CRC_START ^ session)]


def decode(frame: bytes, session: int = 0) -> bytes | None:
    """The body of a frame (without its delimiter), or None where COBS, check or length do not pass.

    The session number counts for messages of scope "session" alone.  An identity of another protocol version may
    have another length: its first two fields tell.
    """
    try:
        if not crc_hqx(frame, CRC_START ^ session):  # first what nearly every frame of a session is
            body = _unstuff(frame[_STUFFED])
            if len(body) == _SESSION_SIZES[body[0]]:
                return body
        if not crc_hqx(frame, CRC_START):
            body = _unstuff(frame[_STUFFED])
            if len(body) == _LINK_SIZES[body[0]] or (body[0] == _IDENTITY and len(body) >= _IDENTITY_PREFIX):
                return body
    except (cobs.DecodeError, IndexError):
        pass
    return None


def any_body(frame: bytes) -> bytes | None:
    """The body of a frame of scope "link" whose check passes, of whatever message and length; else None.

    For a device of another protocol: what it sends is not what this Station expects, but it is sent well.
    """
    if not frame or crc_hqx(frame, CRC_START):
        return None
    try:
        return _unstuff(frame[_STUFFED]) or None
    except cobs.DecodeError:
        return None


class Decoder:
    """Splits a stream into bodies, whatever pieces it comes in; counts the frames that do not pass.

    ``session`` is the number that frames of scope "session" must carry.  ``pending`` is the number of bytes of a
    frame whose end has not come, ``rest`` those bytes: whoever reads the line in the decoder's place takes them, and
    leaves there what it has not handled.  ``overlong``: what comes up to the next delimiter is no frame.
    """

    def __init__(self, session: int = 0) -> None:
        self.session = session
        self.corrupt = 0
        self.rest = b""
        self.overlong = False

    @property
    def pending(self) -> int:
        """Bytes kept that belong to an unfinished frame."""
        return len(self.rest)

    def feed(self, data: bytes) -> list[bytes]:
        """The bodies that these bytes complete, in their order."""
        if self.rest:
            data = self.rest + data
        *frames, self.rest = data.split(b"\0")
        bodies = []
        for frame in frames:
            overlong, self.overlong = self.overlong or len(frame) >= _FRAME_BYTES, False
            if not frame and not overlong:
                continue
            body = None if overlong else decode(frame, self.session)
            if body is None:
                self.corrupt += 1
            else:
                bodies.append(body)
        if len(self.rest) >= _FRAME_BYTES:
            self.rest, self.overlong = b"", True
        return bodies
