"""The native form: what other programs see, what a cut or a flip leaves, what is refused."""

import os
import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun_cli
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory

from station.errors import WorkError
from station.runs import export_run, load_run, mcap_read, recover
from station.runs.mcap_read import decompress, scan_mcap
from station.runs.schema import METADATA, SAMPLE, message_class, metadata_schema, sample_schema
from tests.runs.examples import METADATA as KNOWN
from tests.runs.examples import full_run

COLUMNS = ("t", "reference", "command", "encoder")


def small_log(path: Path, rows: int = 24, chunk: int = 6, finish: bool = True, **kind: object) -> list[int]:
    """A log with few rows and many chunks, written by the mcap library alone; the end of each chunk's record."""
    ends = []
    with path.open("wb") as file:
        writer = Writer(file, **kind)
        writer.start()
        writer.add_metadata("station", {"json": KNOWN.to_json()})
        schema = sample_schema(COLUMNS)
        sample = message_class(SAMPLE, schema)
        metadata = message_class(METADATA, metadata_schema())
        channel = writer.register_channel("/sample", "protobuf", writer.register_schema(SAMPLE, "protobuf", schema))
        other = writer.register_channel("/metadata", "protobuf",
                                        writer.register_schema(METADATA, "protobuf", metadata_schema()))
        writer.add_message(other, 0, metadata(json=KNOWN.to_json()).SerializeToString(), 0)
        writer.flush()
        ends.append(file.tell())
        for row in range(rows):
            data = sample(t=row / 500, reference=row, command=-row, encoder=row / 3).SerializeToString()
            writer.add_message(channel, row * 2_000_000, data, row * 2_000_000)
            if row % chunk == chunk - 1:
                writer.flush()
                ends.append(file.tell())
        if finish:
            writer.finish()
    return ends


def test_other_programs_decode_every_row_by_the_descriptor_in_the_file(tmp_path):
    run = full_run(100)
    export_run(run, tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        rows = [message for _, channel, _, message in reader.iter_decoded_messages() if channel.topic == "/sample"]
    for name, values in run.columns().items():
        np.testing.assert_array_equal([getattr(row, name) for row in rows], values)


def test_the_file_holds_its_metadata_as_a_record_and_as_a_first_message(tmp_path):
    run = full_run(100)
    export_run(run, tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        record = next(iter(reader.iter_metadata()))
        _, channel, _, first = next(iter(reader.iter_decoded_messages(log_time_order=False)))
    assert channel.topic == "/metadata"
    assert record.metadata["json"] == first.json == run.metadata.to_json()


def test_a_log_cut_at_any_byte_is_read_to_its_last_whole_record(tmp_path):
    path = tmp_path / "cut.mcap"
    ends = small_log(path, rows=9, chunk=3, index_types=IndexType.CHUNK)
    whole = load_run(path)
    data = path.read_bytes()
    chunk_ends = _chunk_ends(data)
    assert len(chunk_ends) == len(ends) == 4
    for size in range(len(data) - 1, 0, -1):
        os.truncate(path, size)
        rows = 3 * max(sum(end <= size for end in chunk_ends) - 1, 0)
        if rows == 0:
            with pytest.raises(WorkError, match=r"cut\.mcap: (no rows|not an MCAP file|0 rows|no metadata)"):
                load_run(path)
            continue
        run = load_run(path)
        assert len(run) == rows and run.metadata.zero_id == "bench"
        assert run.metadata.model_extra["cut_short"]
        np.testing.assert_array_equal(run.encoder, whole.encoder[:rows])


def _chunk_ends(data: bytes) -> list[int]:
    """Where each chunk record ends, by the framing of the format alone."""
    position, ends = 8, []
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        position += 9 + length
        if opcode == 6:
            ends.append(position)
    return ends


def test_a_whole_log_does_not_say_that_it_was_cut(tmp_path):
    small_log(tmp_path / "whole.mcap")
    assert "cut_short" not in load_run(tmp_path / "whole.mcap").metadata.model_extra


def test_a_log_whose_unsynced_end_is_zeros_is_read_to_its_last_whole_record(tmp_path):
    ends = small_log(tmp_path / "a.mcap", finish=False)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[ends[2] + 30:] = bytes(len(data) - ends[2] - 30)
    (tmp_path / "b.mcap").write_bytes(data)
    run = load_run(tmp_path / "b.mcap")
    assert len(run) == 12 and "damaged" in run.metadata.model_extra["cut_short"]


def test_a_flip_in_a_closed_log_is_told_and_recover_keeps_what_stands_before(tmp_path):
    ends = small_log(tmp_path / "a.mcap")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[ends[2] + 80] ^= 4
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(WorkError, match="a.mcap: the chunk at byte .* is damaged .*; 'station recover'"):
        load_run(tmp_path / "a.mcap")
    assert recover(tmp_path / "a.mcap", tmp_path / "b.mcap").rows == 12
    assert len(load_run(tmp_path / "b.mcap")) == 12


def test_any_flip_raises_work_errors_alone_and_never_changes_a_row(tmp_path):
    small_log(tmp_path / "a.mcap")
    whole = load_run(tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    path = tmp_path / "b.mcap"
    rng = np.random.default_rng(3)
    for position in rng.choice(len(data), 400, replace=False):
        flipped = bytearray(data)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        for salvage in (False, True):
            try:
                found = scan_mcap(path, salvage)
            except WorkError as error:
                assert "\n" not in str(error)
            else:
                rows = len(found.columns["t"])
                np.testing.assert_array_equal(found.columns["command"], whole.command[:rows])


def test_recover_completes_a_copy_for_other_programs_and_keeps_the_original(tmp_path):
    small_log(tmp_path / "a.mcap", finish=False)
    cut = (tmp_path / "a.mcap").read_bytes()
    cut = cut[:_chunk_ends(cut)[-1] - 5]
    (tmp_path / "a.mcap").write_bytes(cut)
    found = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert found.rows == 18 and "no whole record" in found.cut_short
    assert (tmp_path / "a.mcap").read_bytes() == cut
    run = load_run(tmp_path / "b.mcap")
    assert run.metadata.model_extra["recovered"] == found.cut_short
    np.testing.assert_array_equal(run.encoder, load_run(tmp_path / "a.mcap").encoder)
    with (tmp_path / "b.mcap").open("rb") as file:
        assert make_reader(file, validate_crcs=True).get_summary().statistics.message_count == 19
    with pytest.raises(WorkError, match="exists already"):
        recover(tmp_path / "a.mcap", tmp_path / "a.mcap")


@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_compression_of_the_format_is_read(compression, tmp_path):
    small_log(tmp_path / "a.mcap", compression=compression)
    assert len(load_run(tmp_path / "a.mcap")) == 24


def test_an_unchunked_log_is_read(tmp_path):
    small_log(tmp_path / "a.mcap", use_chunking=False)
    assert len(load_run(tmp_path / "a.mcap")) == 24


def _bomb(compression: str, declared: int, grown: int) -> Chunk:
    import lz4.frame

    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    return Chunk(compression, pack(bytes(grown)), 0, 0, 0, declared)


def test_a_chunk_that_declares_too_much_is_refused():
    with pytest.raises(WorkError, match="f: a chunk of .* at most"):
        decompress("f", _bomb("zstd", (64 << 20) + 1, 10))


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_grows_beyond_what_it_declares_is_not_inflated(compression, monkeypatch):
    chunk = _bomb(compression, 1000, 256 << 20)
    import tracemalloc

    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="its size is not what it says"):
            decompress("f", chunk)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_record_longer_than_its_limit_is_refused_before_it_is_read(tmp_path):
    for opcode, limit in ((6, 64 << 20), (12, 2 << 20)):
        with (tmp_path / "a.mcap").open("wb") as file:
            file.write(b"\x89MCAP0\r\n" + struct.pack("<BQ", opcode, limit + 1))
            file.truncate(limit + 100)
        with pytest.raises(WorkError, match=rf"record of {limit + 1} bytes, at most {limit}"):
            load_run(tmp_path / "a.mcap")


def test_metadata_beyond_a_mebibyte_are_refused(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("station", {"json": '{"note": "' + "x" * (1 << 20) + '"}'})
        schema = sample_schema(COLUMNS)
        writer.register_channel("/sample", "protobuf", writer.register_schema(SAMPLE, "protobuf", schema))
        writer.finish()
    with pytest.raises(WorkError, match="metadata: .* bytes, at most 1048576|no rows"):
        load_run(tmp_path / "a.mcap")


def test_more_rows_than_the_limit_are_refused(tmp_path, monkeypatch):
    small_log(tmp_path / "a.mcap")
    monkeypatch.setattr(mcap_read, "MAX_ROWS", 20)
    with pytest.raises(WorkError, match="a.mcap: more than 20 rows"):
        load_run(tmp_path / "a.mcap")


@pytest.mark.parametrize(("schema", "words"), [
    (b"\x0a\xff\xff", "no usable description"), (metadata_schema(), "no usable description"),
    (sample_schema(("t", "reference")), "column command is missing"),
])
def test_a_description_that_is_no_run_is_refused(schema, words, tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("station", {"json": "{}"})
        channel = writer.register_channel("/sample", "protobuf", writer.register_schema(SAMPLE, "protobuf", schema))
        writer.add_message(channel, 0, b"", 0)
        writer.finish()
    with pytest.raises(WorkError, match=words):
        load_run(tmp_path / "a.mcap")


def test_a_log_of_another_program_is_refused(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/x", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    with pytest.raises(WorkError, match=f"no rows: no whole chunk with messages of {SAMPLE}"):
        load_run(tmp_path / "a.mcap")


def rerun(tmp_path: Path, *arguments: str) -> str:
    """The Rerun command line, its settings in a folder of the test's own, analytics off."""
    program = Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
    settings = {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path),
                "APPDATA": str(tmp_path), "LOCALAPPDATA": str(tmp_path)}
    (tmp_path / "rerun").mkdir(exist_ok=True)
    subprocess.run([program, "analytics", "disable"], env=settings, capture_output=True, timeout=60)
    done = subprocess.run([program, *arguments], env=settings, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def application(printed: str) -> str:
    """The application id of a recording or blueprint, as Rerun prints it."""
    return re.search(r'StoreId\(\s*\w+,\s*"([^"]*)"', printed)[1]


def test_rerun_draws_the_log_by_the_blueprint_beside_it(tmp_path):
    run = full_run(200)
    log, blueprint = tmp_path / "a run kp=2.0.mcap", tmp_path / "a run kp=2.0.rbl"
    export_run(run, log)
    checked = rerun(tmp_path, "mcap", "check", "--full", str(log))
    assert re.search(r"^ok +1 .* /sample +—$", checked, re.MULTILINE)
    rerun(tmp_path, "--save", str(tmp_path / "c.rrd"), str(log))
    loaded = rerun(tmp_path, "rrd", "print", "-v", str(tmp_path / "c.rrd"))
    drawn = rerun(tmp_path, "rrd", "print", "-vvv", str(blueprint))
    assert application(loaded) == application(drawn)
    assert "/sample@station.Sample:message" in loaded
    assert "source_component: station.Sample:message" in drawn
    for column in ("reference", "encoder", "command", "accel", "latency"):
        assert f"[{column}]" in drawn
    rerun(tmp_path, "rrd", "verify", str(blueprint))


def test_rerun_reads_the_recording(tmp_path):
    run = full_run(200)
    export_run(run, tmp_path / "b.rrd")
    recording = rerun(tmp_path, "rrd", "print", "-v", str(tmp_path / "b.rrd"))
    for column in run.columns():
        assert column == "t" or f"/{column}@Scalars:scalars" in recording
    rerun(tmp_path, "rrd", "verify", str(tmp_path / "b.rrd"))


def test_columns_whose_names_differ_by_an_underscore_alone_are_two_columns():
    """Proto3 gives both the same name in JSON unless told otherwise, and then refuses the message."""
    message = message_class(SAMPLE, sample_schema(["t", "x", "x_"]))
    again = message.FromString(message(x=1.0, x_=2.0).SerializeToString())
    assert (again.x, again.x_) == (1.0, 2.0)
