"""Writing MCAP in blocks of rows: each block one chunk, its messages laid out by NumPy.

The library's writer takes one message at a time, at some 10 us each, in Python; here a block of rows costs about as
much as two of them, which is what the thread beside a loop can spare.  All other records are the library's own.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC

_HEAD = struct.Struct("<BQ")
_VARINT_BYTES = 10
_DOUBLE, _VARINT = 1, 0  # protobuf wire types


class Stream(Protocol):
    """Where bytes go."""

    def write(self, data: bytes) -> int:
        """Append."""

    def tell(self) -> int:
        """Bytes appended so far."""


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _padded_varints(values: np.ndarray) -> np.ndarray:
    """(rows, 10) bytes: each integer as a varint of full length, which every reader of protobuf takes."""
    bits = np.asarray(values).astype(np.int64).view(np.uint64)[:, None] >> (7 * np.arange(10, dtype=np.uint64))
    out = (bits & np.uint64(0x7F)).astype(np.uint8)
    out[:, :-1] |= 0x80
    return out


class RowLayout:
    """The bytes of a block of messages that have the same fields: name, field number, whether it is an integer."""

    def __init__(self, channel: int, fields: list[tuple[str, int, bool]]) -> None:
        self.fields = fields
        head: list[tuple[Any, ...]] = [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
                                       ("log_time", "<u8"), ("publish_time", "<u8")]
        tags = {name: _varint(number << 3 | (_VARINT if integer else _DOUBLE)) for name, number, integer in fields}
        for name, _, integer in fields:
            head.append((f"tag {name}", "u1", (len(tags[name]),)))
            head.append((f"value {name}", "u1", (_VARINT_BYTES,)) if integer else (f"value {name}", "<f8"))
        self.blank = np.zeros(1, np.dtype(head))
        self.blank["opcode"], self.blank["channel"] = Opcode.MESSAGE, channel
        self.blank["length"] = self.blank.itemsize - _HEAD.size
        for name, _, _ in fields:
            self.blank[f"tag {name}"] = np.frombuffer(tags[name], np.uint8)

    def lay(self, columns: Mapping[str, np.ndarray], times: np.ndarray, first: int) -> np.ndarray:
        """The records of a block; ``times``: ns; ``first``: number of its first row."""
        made = np.repeat(self.blank, len(times))
        made["sequence"] = (first + np.arange(len(times))) & 0xFFFFFFFF
        made["log_time"] = made["publish_time"] = times
        for name, _, integer in self.fields:
            made[f"value {name}"] = _padded_varints(columns[name]) if integer else columns[name]
        return made


class ChunkWriter:
    """An MCAP file that grows by chunks; ``finish`` writes the closing records."""

    def __init__(self, stream: Stream, library: str) -> None:
        self._stream = stream
        self._compress = zstandard.ZstdCompressor().compress
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._span: tuple[int, int] | None = None
        self._pending = RecordBuilder()  # of the coming chunk
        stream.write(MCAP0_MAGIC)
        self._record(Header("", library))

    def _record(self, record: McapRecord) -> tuple[int, int]:
        """Write a record at once; where it begins, and its length."""
        builder = RecordBuilder()
        record.write(builder)
        data = builder.end()
        begin = self._stream.tell()
        self._stream.write(data)
        return begin, len(data)

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """A metadata record."""
        begin, length = self._record(Metadata(name=name, metadata=entries))
        self._metadata.append(MetadataIndex(offset=begin, length=length, name=name))

    def register(self, topic: str, message: str, description: bytes) -> int:
        """A channel of protobuf messages with its schema, both in the coming chunk; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, name=message, encoding=SchemaEncoding.Protobuf, data=description)
        channel = Channel(id=len(self._channels) + 1, topic=topic, message_encoding=MessageEncoding.Protobuf,
                          metadata={}, schema_id=schema.id)
        self._schemas.append(schema)
        self._channels.append(channel)
        schema.write(self._pending)
        channel.write(self._pending)
        return channel.id

    def chunk(self, channel: int, records: bytes, times: np.ndarray, offsets: np.ndarray) -> None:
        """One chunk of messages of one channel: their records, log times (ns), and where each begins in records."""
        before = self._pending.end()
        data = before + records
        low, high = int(times.min()), int(times.max())
        packed = self._compress(data)
        begin, length = self._record(Chunk(
            compression="zstd", data=packed, message_start_time=low, message_end_time=high,
            uncompressed_crc=zlib.crc32(data), uncompressed_size=len(data)))
        index = np.empty((len(times), 2), "<u8")
        index[:, 0], index[:, 1] = times, offsets + len(before)
        body = struct.pack("<HI", channel, index.nbytes) + index.tobytes()
        at = self._stream.tell()
        self._stream.write(_HEAD.pack(Opcode.MESSAGE_INDEX, len(body)) + body)
        self._chunks.append(ChunkIndex(
            message_start_time=low, message_end_time=high, chunk_start_offset=begin, chunk_length=length,
            message_index_offsets={channel: at}, message_index_length=_HEAD.size + len(body), compression="zstd",
            compressed_size=len(packed), uncompressed_size=len(data)))
        self._counts[channel] = self._counts.get(channel, 0) + len(times)
        self._span = (low, high) if self._span is None else (min(low, self._span[0]), max(high, self._span[1]))

    def message(self, channel: int, data: bytes, time: int) -> None:
        """A chunk that holds one message."""
        record = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(data), channel, 0, time, time) + data
        self.chunk(channel, record, np.array([time]), np.zeros(1, np.int64))

    def finish(self) -> None:
        """Write the closing records; the stream stays open."""
        self._record(DataEnd(0))
        start = self._stream.tell()
        low, high = self._span or (0, 0)
        statistics = Statistics(
            attachment_count=0, channel_count=len(self._channels), channel_message_counts=self._counts,
            chunk_count=len(self._chunks), message_count=sum(self._counts.values()), message_end_time=high,
            message_start_time=low, metadata_count=len(self._metadata), schema_count=len(self._schemas))
        groups: list[tuple[Opcode, list[Any]]] = [
            (Opcode.SCHEMA, self._schemas), (Opcode.CHANNEL, self._channels), (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks), (Opcode.METADATA_INDEX, self._metadata)]
        builder, offsets = RecordBuilder(), []
        for opcode, records in groups:
            begin = builder.count
            for record in records:
                record.write(builder)
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=start + begin,
                                         group_length=builder.count - begin))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = builder.end()
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary))
        self._stream.write(summary)
        self._record(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc))
        self._stream.write(MCAP0_MAGIC)
