"""Recordings for Rerun: measured, nominal and extended beside each other on one timeline, the arm moving in space.

Each run has its tab: the arm of each account and the events on the left; on the right the curves over time, and the
frequency responses that run and simulations show.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from station.diagnose.result import RunComparison
from station.errors import WorkError
from station.model.simulate import Simulation, simulate
from station.rig import Rig
from station.runs.blueprint import recorded
from station.runs.run import RATES, Run
from station.view import arm
from station.view.bode import same_test_picture
from station.view.events import find_events

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "station"
TIMELINE = "device_time"
BODE = "bode"
FRAMES = 60.0
"""Pictures of the arm per second of device time; the curves keep every row."""

COLOURS = {"reference": 0x2AA198FF, "measured": 0x7D8894FF, "nominal": 0xE8722EFF, "re-fitted": 0x9A8FBFFF,
           "extended": 0x3D8BFDFF, "command": 0x5AA469FF}
"""Red, green, blue, opacity; each is read on a light and on a dark ground."""
HEIGHTS = {"measured": 0.0, "nominal": 0.02, "re-fitted": 0.04, "extended": 0.04}
"""Where each arm turns, m above the measured one, so that none hides another."""
LABELS = {"measured": 1.0, "nominal": 0.66, "re-fitted": 0.33, "extended": 0.33}
"""Where along the arm its name stands, of its length."""


Entry = RunComparison | Run
"""What a tab shows: a run that a diagnosis has compared, or a run alone, simulated here on the nominal rig."""


def write_recording(path: str | os.PathLike[str], runs: Sequence[Entry], rig: Rig, *, extended: Rig | None = None,
                    status_names: Mapping[int, str] | None = None, overwrite: bool = True) -> None:
    """Write a recording that opens with one tab for each run.

    A comparison brings measured, nominal and extended (re-fitted where nothing was added), a bare run measured and
    nominal, simulated on ``rig`` from the run's first readings, and, where that is given, the same on ``extended``.
    Time is the device's, from the run's first sample.  ``status_names`` maps status bits to words.  An existing file
    is replaced, unless ``overwrite`` is False; a file is written whole or not at all.  WorkError where it cannot be
    written, or a run's rate is not the rig's.
    """
    import rerun as rr

    target = Path(path)
    if not target.parent.is_dir():
        raise WorkError(f"{target}: cannot be written: no such folder")
    tabs = [_sources(entry, rig, extended) for entry in runs]
    recording = rr.RecordingStream(APPLICATION, recording_id=target.stem)
    with recorded(recording, target, overwrite):
        recording.send_blueprint(_blueprint(tabs, rig))
        recording.send_recording_name(target.stem)
        for number, (run, sources) in enumerate(tabs, start=1):
            _log_run(recording, f"run_{number}", run, sources, rig, status_names)


def _sources(entry: Entry, rig: Rig, extended: Rig | None) -> tuple[Run, dict[str, Simulation]]:
    """A run and its accounts by name: what was measured, in a simulation's form, and the simulations."""
    simulated: dict[str, Simulation]
    if isinstance(entry, Run):
        run = entry.filled(rig.sample_rate)
        if abs(run.sample_rate / rig.sample_rate - 1.0) > RATES:
            raise WorkError(f"{run.name}: sampled at {run.sample_rate:.6g} Hz, rig {rig.name} at "
                            f"{rig.sample_rate:.6g} Hz; name the run's own rig")
        rest = 0.0 if run.accel is None else arm.resting(run.accel, run.sample_rate)
        rigs = {"nominal": rig} | ({} if extended is None else {"extended": extended})
        simulated = {name: simulate(each, run, accel_offset=rest, states=True) for name, each in rigs.items()}
    else:
        run, simulated = entry.run, {"nominal": entry.before}
        simulated |= {"extended": entry.after} if entry.after is not None else {"re-fitted": entry.refit}
    return run, {"measured": Simulation(run.t, run.reference, run.command, run.encoder, run.accel)} | simulated


def _log_run(recording: rr.RecordingStream, root: str, run: Run, sources: Mapping[str, Simulation],
             rig: Rig, status_names: Mapping[int, str] | None) -> None:
    import rerun as rr

    clock = run.t if run.device_time is None else run.device_time
    seconds = np.asarray(clock, float) - float(clock[0])

    def curve(name: str, colour: str, values: np.ndarray) -> None:
        path, width = f"{root}/{name}", 3.0 if colour == "measured" else 1.5
        recording.log(path, rr.SeriesLines(names=colour, colors=COLOURS[colour], widths=width), static=True)
        recording.send_columns(path, [rr.TimeColumn(TIMELINE, duration=seconds)],
                               rr.Scalars.columns(scalars=np.asarray(values, float)))

    curve("angle/reference", "reference", run.reference)
    curve("command", "command", run.command)
    for name, source in sources.items():
        curve(f"angle/{name}", name, source.encoder)
        if name != "measured":
            curve(f"residual/angle/{name}", name, run.encoder - source.encoder)
        if source.accel is None or run.accel is None:
            continue
        curve(f"acceleration/{name}", name, source.accel)
        if name != "measured":
            curve(f"residual/acceleration/{name}", name, run.accel - source.accel)
    for name, source in sources.items():
        _log_arm(recording, f"{root}/arm/{name}", name, source, seconds, rig, run.sample_rate)
    picture = _bode(run, sources)
    if picture is not None:
        recording.log(f"{root}/{BODE}", rr.EncodedImage(contents=picture, media_type="image/png"), static=True)
    for event in find_events(run, rig.command_limit, status_names):
        recording.set_time(TIMELINE, duration=float(seconds[event.row]))
        recording.log(f"{root}/events", rr.TextLog(event.text, level=event.level))


def _bode(run: Run, sources: Mapping[str, Simulation]) -> bytes | None:
    """The picture of the frequency responses; None for a run that shows none."""
    accounts = {name: replace(run, command=source.command, encoder=source.encoder, accel=source.accel)
                for name, source in sources.items()}
    try:
        return same_test_picture(accounts, {name: f"#{COLOURS[name] >> 8:06x}" for name in accounts})
    except WorkError:
        return None


def _log_arm(recording: rr.RecordingStream, path: str, name: str, source: Simulation, seconds: np.ndarray, rig: Rig,
             rate: float) -> None:
    import rerun as rr

    length = arm.drawn_length(rig)
    angle = np.asarray(source.encoder, float) * rig.angle_per_count
    if source.shape is not None:
        along = np.linspace(0.0, length, source.shape.shape[1])
        deflection = source.shape - np.outer(angle, along)
    else:
        deflection = arm.estimated_shape(rig, angle, source.accel, rate)
    points = arm.drawn_points(angle, deflection, length, arm.EXAGGERATION, HEIGHTS[name])
    rows = np.arange(0, len(seconds), max(round(rate / FRAMES), 1))
    time = [rr.TimeColumn(TIMELINE, duration=seconds[rows])]
    colour = COLOURS[name]
    recording.log(f"{path}/beam", rr.LineStrips3D.from_fields(colors=colour, radii=0.004), static=True)
    recording.send_columns(f"{path}/beam", time, rr.LineStrips3D.columns(
        strips=points[rows].astype(np.float32)))
    recording.log(f"{path}/tip", rr.Points3D.from_fields(colors=colour, radii=0.011), static=True)
    recording.send_columns(f"{path}/tip", time, rr.Points3D.columns(positions=points[rows, -1].astype(np.float32)))
    marked = points[rows, round(LABELS[name] * (points.shape[1] - 1))]
    recording.log(f"{path}/name", rr.Points3D.from_fields(colors=colour, radii=0.004, labels=name,
                                                          show_labels=True), static=True)
    recording.send_columns(f"{path}/name", time, rr.Points3D.columns(positions=marked.astype(np.float32)))
    recording.log(f"{path}/hub", rr.Points3D([[0.0, 0.0, HEIGHTS[name]]], colors=colour, radii=0.02), static=True)


def _blueprint(tabs: Sequence[tuple[Run, Mapping[str, Simulation]]], rig: Rig) -> rrb.Blueprint:
    import rerun.blueprint as rrb

    views = [_tab(f"run_{number}", run, sources, rig) for number, (run, sources) in enumerate(tabs, 1)]
    layout = views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)
    return rrb.Blueprint(layout, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
                         rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="playing", loop_mode="all"),
                         auto_views=False)


def _tab(root: str, run: Run, sources: Mapping[str, Simulation], rig: Rig) -> rrb.Horizontal:
    import rerun.blueprint as rrb

    length = arm.drawn_length(rig)
    facing = float(np.median(run.encoder)) * rig.angle_per_count
    middle = 0.5 * length * np.array([np.cos(facing), np.sin(facing), 0.0])
    space = rrb.Spatial3DView(
        origin=f"{root}/arm", name=f"Arm from above, deflection × {arm.EXAGGERATION:g}",
        eye_controls=rrb.EyeControls3D(position=middle + np.array([0.0, -0.35, 2.2]) * length,
                                       look_target=middle, eye_up=[0.0, 1.0, 0.0]))
    left = rrb.Vertical(space, rrb.TextLogView(origin=f"{root}/events", name="Events"), row_shares=[4, 1])

    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=root, contents=[f"$origin/{path}/**" for path in paths], name=name,
                                  axis_x=rrb.TimeAxis(link="LinkToGlobal"),
                                  plot_legend=rrb.PlotLegend("LeftTop"))

    plots = [plot("Angle (encoder counts)", "angle"),
             plot("Angle: measured − simulated (counts)", "residual/angle")]
    simulated = [source for name, source in sources.items() if name != "measured"]
    if run.accel is not None and any(source.accel is not None for source in simulated):
        plots += [plot("Acceleration (counts)", "acceleration"),
                  plot("Acceleration: measured − simulated (counts)", "residual/acceleration")]
    plots.append(plot("Command (counts)", "command"))
    over_time = rrb.Vertical(*plots, name="Over time")
    right = rrb.Tabs(over_time, rrb.Spatial2DView(origin=f"{root}/{BODE}", name="Frequency responses (Bode)"),
                     active_tab=0)
    return rrb.Horizontal(left, right, column_shares=[2, 3], name=run.name)
