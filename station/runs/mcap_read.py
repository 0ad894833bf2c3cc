"""Reading the native form: whole files, and files cut short, up to the last whole record.

Records are framed here (opcode, length, body), so that every length is checked before anything is read or
decompressed; the mcap library decodes their bodies.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from station.errors import WorkError
from station.runs.columns import MAX_ROWS
from station.runs.files import check_input, reason
from station.runs.run import MAX_METADATA_BYTES, Run, RunMetadata
from station.runs.schema import METADATA, METADATA_RECORD, SAMPLE, message_class, sample_columns

MAX_CHUNK_BYTES = 64 << 20
_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_BLOCK_ROWS = 4096
_LIMITS = {Opcode.CHUNK: MAX_CHUNK_BYTES, Opcode.METADATA: 2 * MAX_METADATA_BYTES,
           Opcode.SCHEMA: MAX_METADATA_BYTES, Opcode.CHANNEL: MAX_METADATA_BYTES,
           Opcode.MESSAGE: 2 * MAX_METADATA_BYTES, Opcode.DATA_END: 1024}
_UNREADABLE = (ValueError, struct.error, OverflowError, RuntimeError, KeyError, McapError, DecodeError,
               zstandard.ZstdError)


class _Damaged(Exception):
    """A record that does not hold what it promises; the text says where and what."""


@dataclass(frozen=True)
class McapContents:
    """What a log holds: its columns, its metadata, and why it ended early (None: it is complete)."""

    columns: dict[str, np.ndarray]
    metadata: RunMetadata
    cut_short: str | None


def read_mcap(path: str | os.PathLike[str]) -> Run:
    """Read a log.  One cut short is read to its last whole record; its metadata then says so (``cut_short``).

    Raises WorkError, one line naming the file, where it is not a log of Station, is damaged although it was
    closed, or exceeds a limit.
    """
    path = Path(path)
    contents = scan_mcap(path)
    metadata = contents.metadata
    if contents.cut_short:
        metadata = metadata.model_copy(update={"cut_short": contents.cut_short})
    return Run.from_columns(str(path), path.stem, contents.columns, metadata)


def scan_mcap(path: str | os.PathLike[str], salvage: bool = False) -> McapContents:
    """Read columns and metadata; with ``salvage``, what stands before damage in a file that was closed too."""
    path = check_input(path)
    decoder = _Decoder(str(path))
    cut_short: str | None = "the closing records are missing"
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise WorkError(f"{path}: not an MCAP file")
            closed = _ends_closed(file, size)
            try:
                for position, opcode, body in _records(str(path), file, size):
                    if opcode == Opcode.DATA_END:
                        cut_short = None if closed else cut_short
                        break
                    decoder.record(position, opcode, body)
            except _Damaged as damage:
                if closed and not salvage:
                    raise WorkError(f"{path}: {damage}; 'station recover' keeps what stands before") from None
                cut_short = str(damage)
    except OSError as error:
        raise WorkError(f"{path}: cannot be read ({reason(error)})") from None
    return McapContents(decoder.columns(), decoder.metadata(), cut_short)


def _ends_closed(file: BinaryIO, size: int) -> bool:
    """Whether the file ends with MCAP's closing magic; the position is kept."""
    position = file.tell()
    file.seek(max(position, size - len(MCAP0_MAGIC)))
    closed = file.read() == MCAP0_MAGIC
    file.seek(position)
    return closed


def _records(label: str, file: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """Position, opcode and body of the records that matter, each whole; _Damaged where the rest is none."""
    position = file.tell()
    while position < size:
        frame = file.read(_FRAME.size)
        opcode, length = _FRAME.unpack(frame) if len(frame) == _FRAME.size else (0, 0)
        if opcode == 0 or length > size - position - _FRAME.size:
            raise _Damaged(f"no whole record from byte {position} of {size} on")
        if opcode in _LIMITS:
            _check_limit(label, opcode, length)
            yield position, opcode, file.read(length)
        else:
            file.seek(length, os.SEEK_CUR)
        position += _FRAME.size + length


def _check_limit(label: str, opcode: int, length: int) -> None:
    if length > _LIMITS[Opcode(opcode)]:
        raise WorkError(f"{label}: a {Opcode(opcode).name.lower()} record of {length} bytes, "
                        f"at most {_LIMITS[Opcode(opcode)]}")


def decompress(label: str, chunk: Chunk) -> bytes:
    """A chunk's records, never more than the limit; its checksum is verified.  Raises ValueError where wrong."""
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise WorkError(f"{label}: a chunk of {chunk.uncompressed_size} bytes, at most {MAX_CHUNK_BYTES}")
    most = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        data = decompressor.stream_reader(chunk.data).read(most)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise WorkError(f"{label}: chunks compressed by {chunk.compression[:20]!r} are not read")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("its size is not what it says")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its checksum is wrong")
    return data


class _Decoder:
    """Collects rows and metadata from records, in file order; the last metadata counts."""

    def __init__(self, label: str) -> None:
        self.label = label
        self.schemas: dict[int, Schema] = {}
        self.handlers: dict[int, Callable[[bytes], None]] = {}
        self.names: list[str] = []
        self.rows = 0
        self._values: Callable[[bytes], tuple[float, ...]] | None = None
        self._block: list[tuple[float, ...]] = []
        self._blocks: list[list[np.ndarray]] = []
        self._json: str | None = None

    def record(self, position: int, opcode: int, body: bytes) -> None:
        """Take one record; _Damaged where its body is not what the opcode says."""
        try:
            if opcode == Opcode.CHUNK:
                self._chunk(decompress(self.label, Chunk.read(ReadDataStream(BytesIO(body)))))
            else:
                self._plain(opcode, body)
        except _UNREADABLE as error:
            kind = Opcode(opcode).name.lower()
            raise _Damaged(f"the {kind} at byte {position} is damaged ({error or type(error).__name__})") from None

    def _chunk(self, data: bytes) -> None:
        position, size = 0, len(data)
        while position < size:
            opcode, length = _FRAME.unpack_from(data, position)
            position += _FRAME.size
            if length > size - position:
                raise ValueError("half a record in it")
            if opcode in _LIMITS:
                _check_limit(self.label, opcode, length)
                self._plain(opcode, data[position:position + length])
            position += length

    def _plain(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.MESSAGE:
            handler = self.handlers.get(_MESSAGE.unpack_from(body)[0])
            if handler is not None:
                handler(body[_MESSAGE.size:])
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(body)))
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            self._channel(Channel.read(ReadDataStream(BytesIO(body))))
        elif opcode == Opcode.METADATA:
            record = Metadata.read(ReadDataStream(BytesIO(body)))
            if record.name == METADATA_RECORD:
                self._json = record.metadata["json"]

    def _channel(self, channel: Channel) -> None:
        schema = self.schemas.get(channel.schema_id)
        if schema is None or channel.id in self.handlers or schema.encoding != "protobuf":
            return
        if schema.name == SAMPLE and self._values is None:
            message: Any = message_class(SAMPLE, schema.data)
            self.names = sample_columns(message)
            parse, values = message.FromString, attrgetter(*self.names)
            self._values = lambda data: values(parse(data))
            self.handlers[channel.id] = self._row
        elif schema.name == METADATA:
            message = message_class(METADATA, schema.data)
            self.handlers[channel.id] = lambda data: self._metadata(message.FromString(data).json)

    def _metadata(self, text: Any) -> None:
        self._json = str(text)

    def _row(self, data: bytes) -> None:
        self._block.append(self._values(data))
        self.rows += 1
        if self.rows > MAX_ROWS:
            raise WorkError(f"{self.label}: more than {MAX_ROWS} rows")
        if len(self._block) == _BLOCK_ROWS:
            self._close_block()

    def _close_block(self) -> None:
        self._blocks.append([np.array(values) for values in zip(*self._block, strict=True)])
        self._block = []

    def columns(self) -> dict[str, np.ndarray]:
        """The columns found; WorkError where there are none."""
        if not self.names:
            raise WorkError(f"{self.label}: no rows: no whole chunk with messages of {SAMPLE}")
        if self._block:
            self._close_block()
        parts = zip(*self._blocks, strict=True) if self._blocks else [[np.zeros(0)]] * len(self.names)
        return {name: np.concatenate(list(part)) for name, part in zip(self.names, parts, strict=True)}

    def metadata(self) -> RunMetadata:
        """The last metadata found; WorkError where there is none or it is not valid."""
        if self._json is None:
            raise WorkError(f"{self.label}: no metadata of Station")
        return RunMetadata.from_json(self.label, self._json)
