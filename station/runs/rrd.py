"""Export for Rerun: a recording with one line for each column, and its blueprint inside."""

from __future__ import annotations

import os
from pathlib import Path

from station.runs.blueprint import COLOURS, VIEWS, recorded
from station.runs.run import Run


def write_rrd(run: Run, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write a recording that opens with reference, angle, command and acceleration over time in seconds."""
    import rerun as rr
    import rerun.blueprint as rrb

    columns = run.columns()
    seconds = rr.TimeColumn("t", duration=columns.pop("t"))
    views = [rrb.TimeSeriesView(name=name, contents=[f"/{column}" for column in wanted if column in columns])
             for name, wanted in VIEWS if any(column in columns for column in wanted)]
    recording = rr.RecordingStream("station", recording_id=run.name)
    with recorded(recording, Path(path), overwrite):
        recording.send_blueprint(rrb.Blueprint(rrb.Vertical(*views), rrb.TimePanel(state="collapsed")))
        recording.send_recording_name(run.name)
        recording.log("metadata", rr.TextDocument(run.metadata.to_json()), static=True)
        for name, values in columns.items():
            recording.log(name, rr.SeriesLines(names=name, colors=COLOURS.get(name)), static=True)
            recording.send_columns(name, [seconds], rr.Scalars.columns(scalars=values.astype(float)))
