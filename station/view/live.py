"""The live view of a test: takes the loop's rows, never holds it up, drops what the viewer cannot take, and counts."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from station.rig import Rig
from station.runs.columns import LOG_COLUMNS
from station.runs.run import RunMetadata
from station.view.arm import EXAGGERATION, drawn_length, drawn_points
from station.view.observer import Observer
from station.view.recording import APPLICATION, TIMELINE
from station.view.viewer import free_port, start
from station.view.web import LOOPBACK

CAPACITY = 8192
"""Rows that may wait for the viewer."""
PERIOD = 0.05
"""Seconds between two deliveries to the viewer."""
CONNECTS_WITHIN, ANSWERS_WITHIN = 20.0, 1.0
"""Seconds that the viewer may take to start, and to take a delivery, before it counts as lost."""
PATHS = {"reference": "angle/reference", "encoder": "angle/measured", "command": "command", "accel": "acceleration",
         "latency": "timing/latency", "slack": "timing/slack"}


class Sink(Protocol):
    """What the loop writes to; ``station.loop.sink.LogSink`` has the same form."""

    def append(self, row: Sequence[float]) -> None: ...
    def update(self, metadata: RunMetadata) -> None: ...
    def close(self) -> None: ...


class LiveView:
    """Show rows (in the order of ``LOG_COLUMNS``) in Rerun while a test runs.

    ``append`` puts a row on a bounded queue and returns; a thread of its own sends what waits, 20 times a second.
    Where the queue is full, or the viewer is lost, rows are dropped and counted in ``dropped``; nothing is raised.
    The arm is drawn from the state that the rig's model estimates (``Observer``), its deflection exaggerated.
    """

    def __init__(self, rig: Rig, *, url: str | None = None, capacity: int = CAPACITY) -> None:
        """``url``: of a viewer that runs already (rerun+http://127.0.0.1:PORT/proxy), else one is started."""
        self.shown = 0
        self.failure: str | None = None
        self._refused = self._lost = 0
        self._rig, self._capacity = rig, capacity
        self._queue: deque[Sequence[float]] = deque()
        self._closing, self._connected = threading.Event(), threading.Event()
        self._observer = Observer(rig)
        self.viewer = None
        if url is None:
            port = free_port()
            self.viewer = start(["--hide-welcome-screen"], port)
            url = f"rerun+http://{LOOPBACK}:{port}/proxy"
        self.url = url
        self._thread = threading.Thread(target=self._work, args=(url,), name="station-live-view", daemon=True)
        self._thread.start()

    def wait(self, seconds: float = CONNECTS_WITHIN) -> None:
        """Let the viewer start and connect, before a test begins: what is imported and started meanwhile would
        disturb it.  Returns too where it does not come."""
        self._connected.wait(seconds)

    def append(self, row: Sequence[float]) -> None:
        """Offer one row; returns at once."""
        if len(self._queue) < self._capacity:
            self._queue.append(row)
        else:
            self._refused += 1

    def update(self, metadata: RunMetadata) -> None:
        """Metadata is not drawn."""

    def close(self, patience: float = 2.0) -> None:
        """Send what waits, for at most ``patience`` seconds; the viewer stays open."""
        self._closing.set()
        self._thread.join(patience)
        self._capacity = 0

    @property
    def dropped(self) -> int:
        """Rows that the view did not take, or no longer shows."""
        waiting = len(self._queue) if self._capacity == 0 else 0
        return self._refused + self._lost + waiting

    def _work(self, url: str) -> None:
        try:
            recording = self._connect(url)
            last = False
            while not last:
                last = self._closing.wait(PERIOD)
                self._deliver(recording)
        except Exception as error:          # the view is lost, the test goes on
            self._connected.set()
            self.failure = str(error).splitlines()[0] if str(error) else type(error).__name__
            self._capacity = 0

    def _connect(self, url: str) -> Any:
        import rerun as rr

        recording = rr.RecordingStream(APPLICATION)
        recording.connect_grpc(url, default_blueprint=_blueprint())
        for path in PATHS.values():
            recording.log(path, rr.SeriesLines(names=path.rpartition("/")[2], widths=1.5), static=True)
        recording.flush(timeout_sec=CONNECTS_WITHIN)
        self._connected.set()
        return recording

    def _deliver(self, recording: Any) -> None:
        rows = [self._queue.popleft() for _ in range(len(self._queue))]
        if not rows:
            return
        try:
            self._send(recording, dict(zip(LOG_COLUMNS, np.array(rows, dtype=float).T, strict=True)))
            recording.flush(timeout_sec=ANSWERS_WITHIN)
        except Exception:
            self._lost += len(rows)
            raise
        self.shown += len(rows)

    def _send(self, recording: Any, columns: dict[str, np.ndarray]) -> None:
        import rerun as rr

        time = [rr.TimeColumn(TIMELINE, duration=columns["t"])]
        for name, path in PATHS.items():
            recording.send_columns(path, time, rr.Scalars.columns(scalars=columns[name]))
        for command, encoder, accel in zip(columns["command"], columns["encoder"], columns["accel"], strict=True):
            self._observer.see(command, encoder, accel)
        points = drawn_points(np.array([self._observer.angle]), self._observer.deflection[None, :],
                              drawn_length(self._rig), EXAGGERATION)
        recording.set_time(TIMELINE, duration=float(columns["t"][-1]))
        recording.log("arm/beam", rr.LineStrips3D(points.astype(np.float32), radii=0.005))
        recording.log("arm/tip", rr.Points3D(points[:, -1].astype(np.float32), radii=0.011))


def shared_view(rig: Rig) -> Callable[[], LiveView]:
    """Makes live views, one for each test, of which the first starts the viewer and the others join it."""
    urls: list[str] = []

    def make() -> LiveView:
        view = LiveView(rig, url=urls[0] if urls else None)
        urls[:] = [view.url]
        view.wait()
        return view

    return make


class LogAndView:
    """A sink for the loop: each row goes to the log first, whose errors count, then to the view, whose never do.

    ``tell`` is called at the end with what the view has missed, if anything.
    """

    def __init__(self, log: Sink, view: LiveView, tell: Callable[[str], None]) -> None:
        self._log, self._view, self._tell = log, view, tell

    def append(self, row: Sequence[float]) -> None:
        """Log the row, then offer it to the view."""
        self._log.append(row)
        self._view.append(row)

    def update(self, metadata: RunMetadata) -> None:
        """Hand the metadata to the log."""
        self._log.update(metadata)

    def close(self) -> None:
        """Close the log, then the view."""
        try:
            self._log.close()
        finally:
            self._view.close()
            if missed := self._view.dropped:
                why = f" ({self._view.failure})" if self._view.failure else ""
                self._tell(f"the live view missed {missed} rows{why}; the log is written apart from it")


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    plots = [rrb.TimeSeriesView(origin="/", contents=f"/{path}/**", name=name,
                                axis_x=rrb.TimeAxis(link="LinkToGlobal"))
             for path, name in (("angle", "Angle (encoder counts)"), ("command", "Command (counts)"),
                                ("acceleration", "Acceleration (counts)"), ("timing", "Timing (s)"))]
    space = rrb.Spatial3DView(origin="/arm", name=f"Arm by the model's state estimate, deflection × {EXAGGERATION:g}",
                              eye_controls=rrb.EyeControls3D(position=[0.2, -0.15, 0.9], look_target=[0.2, 0.0, 0.0],
                                                             eye_up=[0.0, 1.0, 0.0]))
    return rrb.Blueprint(rrb.Horizontal(space, rrb.Vertical(*plots), column_shares=[2, 3]),
                         rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
                         rrb.TimePanel(state="collapsed", timeline=TIMELINE), auto_views=False)
