"""How Rerun draws a log: its views and what stands in them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from station.runs.files import new_file

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

# view name, columns, in the order drawn
VIEWS = (
    ("Angle (counts)", ("reference", "reference_shaped", "encoder")),
    ("Command (counts)", ("command", "command_sent")),
    ("Acceleration (counts)", ("accel",)),
    ("Timing (s)", ("latency", "slack")),
)
COLOURS = {"reference": 0x888888FF, "reference_shaped": 0xBBBBBBFF, "encoder": 0x1F77B4FF, "command": 0xD62728FF,
           "command_sent": 0xFF9896FF, "accel": 0x2CA02CFF, "latency": 0x9467BDFF, "slack": 0x8C564BFF}


def blueprint_path(path: Path) -> Path:
    """The blueprint that goes with a log: the same name, ``.rbl``."""
    return path.with_suffix(".rbl")


def write_blueprint(path: Path, columns: Sequence[str]) -> None:
    """Write the blueprint of the MCAP log of the same name.

    Rerun applies a blueprint to recordings of its application id, which for a log is the file's stem with
    underscores for points.  Each line is one field of the message ``station.Sample`` on ``/sample``, chosen by a
    component mapping.
    """
    _load_rerun()
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun_bindings import new_blueprint

    views = [_view(name, [column for column in wanted if column in columns]) for name, wanted in VIEWS
             if any(column in columns for column in wanted)]
    blueprint = rrb.Blueprint(rrb.Vertical(*views), rrb.TimePanel(state="collapsed", timeline="message_log_time"))
    stream = rr.RecordingStream._from_native(new_blueprint(
        application_id=path.stem.replace(".", "_"), make_default=False, make_thread_default=False,
        default_enabled=True))
    with recorded(stream, path, overwrite=True):
        stream.send_blueprint(blueprint)


@contextmanager
def recorded(recording: rr.RecordingStream, path: Path, overwrite: bool = False) -> Iterator[None]:
    """What a recording is sent meanwhile becomes a file, whole or not at all.  WorkError where it cannot be written.

    It is made in memory: what Rerun writes to a file by itself waits for ever where the disk is full.
    """
    made = recording.binary_stream()
    with new_file(path, overwrite) as part:
        try:
            yield
        finally:
            recording.disconnect()
        part.write_bytes(made.read() or b"")


def _load_rerun() -> None:
    """Import rerun with only its errors shown: it warns of file names such as ``kp=2.0`` otherwise."""
    level = os.environ.get("RUST_LOG")
    os.environ.setdefault("RUST_LOG", "error")
    try:
        import_module("rerun")
    finally:
        if level is None:
            del os.environ["RUST_LOG"]


def _view(name: str, columns: Sequence[str]) -> rrb.TimeSeriesView:
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    lines = []
    for column in columns:
        line = rr.SeriesLines(colors=COLOURS[column], names=column, widths=1.5).visualizer()
        line.mappings = [VisualizerComponentMapping("Scalars:scalars", ComponentSourceKind.SourceComponent,
                                                    source_component="station.Sample:message",
                                                    selector=f".{column}")]
        lines.append(line)
    return rrb.TimeSeriesView(origin="/", contents="/sample", name=name, overrides={"/sample": lines})
