"""The wire protocol as firmware/protocol.toml defines it: messages, their binary form, and the protocol's hash."""

from __future__ import annotations

import json
import struct
import tomllib
import zlib
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cached_property
from typing import Any

from station.device.firmware import firmware_folder

_FORMATS = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i"}


@dataclass(frozen=True)
class Field:
    """One field: its wire type (u8 to i32, or char[N]: text padded with zeros), unit and meaning."""

    name: str
    type: str
    unit: str = ""
    doc: str = ""

    @cached_property
    def text_size(self) -> int:
        """N of char[N], else 0."""
        return int(self.type[5:-1]) if self.type.startswith("char[") else 0

    @cached_property
    def format(self) -> str:
        """The letter of the struct module."""
        return f"{self.text_size}s" if self.text_size else _FORMATS[self.type]


@dataclass(frozen=True)
class Message:
    """One message; ``body`` is its code and fields, before CRC and COBS."""

    name: str
    code: int
    sender: str
    fields: tuple[Field, ...]
    scope: str = "link"
    doc: str = ""

    @cached_property
    def struct(self) -> struct.Struct:
        """Code and fields, little-endian, without padding."""
        return struct.Struct("<B" + "".join(field.format for field in self.fields))

    @property
    def body_size(self) -> int:
        """Bytes of code and fields."""
        return self.struct.size

    @property
    def wire_size(self) -> int:
        """Bytes of the frame: one byte of COBS (enough below 254 bytes), body, check, delimiter."""
        return self.struct.size + 5

    @cached_property
    def values(self) -> Any:
        """The named tuple that holds the fields."""
        return namedtuple(self.name.capitalize(), [field.name for field in self.fields])

    @property
    def in_session(self) -> bool:
        """Whether the session number is mixed into the CRC."""
        return self.scope == "session"

    def pack(self, **values: Any) -> bytes:
        """The body; struct.error where a value does not fit, TypeError where names do not agree."""
        return self.struct.pack(self.code, *self.values(**values))

    def unpack(self, body: bytes) -> Any:
        """The fields of a body as a named tuple; text without its padding."""
        values = self.struct.unpack(body)[1:]
        if any(field.text_size for field in self.fields):
            values = [value.rstrip(b"\0").decode("ascii", "replace") if field.text_size else value
                      for field, value in zip(self.fields, values, strict=True)]
        return self.values(*values)


@dataclass(frozen=True)
class Protocol:
    """All of firmware/protocol.toml."""

    version: int
    limits: Mapping[str, int]
    enums: Mapping[str, Mapping[str, int]]
    flags: Mapping[str, Mapping[str, int]]
    messages: Mapping[str, Message]

    @classmethod
    def from_toml(cls, text: str) -> Protocol:
        """Parse the definition; ValueError where it contradicts itself."""
        table = tomllib.loads(text)
        messages = {}
        for row in table["message"]:
            fields = tuple(Field(**field) for field in row.pop("fields"))
            messages[row["name"]] = Message(fields=fields, **row)
        protocol = cls(table["version"], table["limits"], table["enums"], table["flags"], messages)
        protocol._check(len(table["message"]))
        return protocol

    def _check(self, rows: int) -> None:
        codes = [message.code for message in self.messages.values()]
        if len(self.messages) != rows or len(set(codes)) != rows:
            raise ValueError("protocol: two messages share a name or a code")
        for message in self.messages.values():
            if message.wire_size > min(self.limits["frame_bytes"], 254):
                raise ValueError(f"protocol: message {message.name} is longer than a frame")
            if (message.code >= 0x80) != (message.sender == "device") or message.code in (0, 0x80):
                raise ValueError(f"protocol: message {message.name}: code {message.code:#x} is not its sender's")

    @cached_property
    def hash(self) -> int:
        """CRC-32 of what the two sides must agree on (not of the explanations)."""
        agreed = [self.version, dict(self.limits), self.enums, self.flags,
                  [[m.name, m.code, m.sender, m.scope, [[f.name, f.type, f.unit] for f in m.fields]]
                   for m in self.messages.values()]]
        return zlib.crc32(json.dumps(agreed, sort_keys=True).encode())


PROTOCOL = Protocol.from_toml((firmware_folder() / "protocol.toml").read_text(encoding="utf-8"))
MESSAGES = PROTOCOL.messages
LIMITS = PROTOCOL.limits
MESSAGE_OF_CODE = {message.code: message for message in MESSAGES.values()}


def _names(kind: type, name: str, values: Mapping[str, int]) -> Any:
    return kind(name, {key.upper(): value for key, value in values.items()})


State = _names(IntEnum, "State", PROTOCOL.enums["state"])
Result = _names(IntEnum, "Result", PROTOCOL.enums["result"])
Fault = _names(IntEnum, "Fault", PROTOCOL.enums["fault"])
Reset = _names(IntEnum, "Reset", PROTOCOL.enums["reset"])
Status = _names(IntFlag, "Status", {key: 1 << bit for key, bit in PROTOCOL.flags["status"].items()})
BoardFlags = _names(IntFlag, "BoardFlags", {key: 1 << bit for key, bit in PROTOCOL.flags["board"].items()})
InputFlags = _names(IntFlag, "InputFlags", {key: 1 << bit for key, bit in PROTOCOL.flags["input"].items()})
