"""What a row costs in the log, and how long a 10-minute run at 500 Hz takes to load.

    python scripts/bench/log_io.py [--minutes 10]

Rows are written in chunks of 25, as a thread beside a 500 Hz loop does every 50 ms.  The peer is the MCAP library
itself: its writer (one message at a time) and its reader with mcap-protobuf-support, in the same run.

Wanted: below 10 us per row; below 4 s from MCAP, below 0.3 s from Parquet.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from station.runs import export_run, load_run
from station.runs.columns import LOG_COLUMNS
from station.runs.mcap_log import _Encoder, _Pieces
from station.runs.run import RunMetadata
from station.runs.schema import SAMPLE, message_class, sample_schema

EACH = 25
WANTED_US, WANTED_MCAP, WANTED_PARQUET = 10.0, 4.0, 0.3


def made(count: int) -> list[tuple[float, ...]]:
    """Rows of a log."""
    return [(i, i / 500.0, 100.0, float(i % 400 - 200), float(i % 300), float(i % 17), i / 500.0, 5.0 + i / 500.0, 1,
             float(i % 400 - 199), 1e-4 + 1e-9 * (i % 1000), 1.9e-3) for i in range(count)]


def ours(path: Path, rows: list[tuple[float, ...]]) -> float:
    """Microseconds per row of Station's writer."""
    file = _Pieces(path, "wb")
    encoder = _Encoder(file, RunMetadata(), LOG_COLUMNS)
    begun = time.perf_counter()
    for start in range(0, len(rows), EACH):
        encoder.rows_of(rows[start:start + EACH])
        file.commit()
    spent = time.perf_counter() - begun
    encoder.finish(None)
    file.commit()
    file.close()
    return 1e6 * spent / len(rows)


def theirs(path: Path, rows: list[tuple[float, ...]]) -> float:
    """Microseconds per row of the library's writer."""
    schema = sample_schema(LOG_COLUMNS)
    message = message_class(SAMPLE, schema)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/sample", MessageEncoding.Protobuf,
                                          writer.register_schema(SAMPLE, SchemaEncoding.Protobuf, schema))
        begun = time.perf_counter()
        for index, row in enumerate(rows):
            data = message(**dict(zip(LOG_COLUMNS, row, strict=True))).SerializeToString()
            writer.add_message(channel, round(row[1] * 1e9), data, round(row[1] * 1e9), index)
            if index % EACH == EACH - 1:
                writer.flush()
        spent = time.perf_counter() - begun
        writer.finish()
    return 1e6 * spent / len(rows)


def read_by_library(path: Path) -> int:
    """Rows that the library's own reader decodes."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(topics=["/sample"]))


def timed(work: object, *arguments: object) -> float:
    """Seconds."""
    begun = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - begun


def main() -> int:
    """Write, read; print figures and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    options = parser.parse_args()
    rows = made(round(options.minutes * 60 * 500))
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs; {len(rows)} rows")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mine, peers = ours(folder / "ours.mcap", rows), theirs(folder / "theirs.mcap", rows)
        print(f"write: {mine:.2f} us per row; the library's writer {peers:.2f}; ratio {mine / peers:.2f}; wanted below "
              f"{WANTED_US:g}")
        load = min(timed(load_run, folder / "ours.mcap") for _ in range(3))
        library = timed(read_by_library, folder / "ours.mcap")
        print(f"load from MCAP: {load:.2f} s; the library's reader {library:.2f} s; ratio {load / library:.2f}; wanted "
              f"below {WANTED_MCAP:g}")
        export_run(load_run(folder / "ours.mcap"), folder / "ours.parquet")
        load_run(folder / "ours.parquet")
        parquet = min(timed(load_run, folder / "ours.parquet") for _ in range(3))
        print(f"load from Parquet: {parquet:.3f} s; wanted below {WANTED_PARQUET:g}")
    good = mine < WANTED_US and load < WANTED_MCAP and parquet < WANTED_PARQUET
    print("met" if good else "NOT MET")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
