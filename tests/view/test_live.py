"""The live view never holds up the loop, and every row is either shown or counted as dropped."""

from __future__ import annotations

import time

import pytest

from station.errors import WorkError
from station.rig import load_rig
from station.runs.run import RunMetadata
from station.view import live, viewer
from station.view.live import LiveView, LogAndView

RIG = load_rig("sflr")
NOBODY = "rerun+http://127.0.0.1:1/proxy"


def row(i: int) -> tuple[float, ...]:
    return (i, i / 500.0, 10.0, 1.0, 2.0, 3.0, i / 500.0, i / 500.0, 0, 1.0, 1e-4, 1e-3)


@pytest.fixture(autouse=True)
def own_settings(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setattr(viewer.platformdirs, "user_config_dir",
                        lambda *_, **__: str(tmp_path_factory.getbasetemp() / "settings"))


def test_rows_are_shown_until_the_viewer_dies_and_counted_after() -> None:
    port = viewer.free_port()
    server = viewer.start(["--serve-grpc"], port)
    try:
        view = LiveView(RIG, url=f"rerun+http://127.0.0.1:{port}/proxy")
        for i in range(200):
            view.append(row(i))
        limit = time.monotonic() + 30.0
        while view.shown < 200 and time.monotonic() < limit:
            time.sleep(0.02)
        assert (view.shown, view.dropped, view.failure) == (200, 0, None)
        server.kill()
        server.wait()
        taken = []
        for i in range(200, 800):
            begun = time.perf_counter()
            view.append(row(i))
            taken.append(time.perf_counter() - begun)
            time.sleep(0.002)
        view.close()
        assert view.shown + view.dropped == 800 and view.dropped > 300
        assert view.failure is not None
        assert sorted(taken)[570] < 1e-3        # 95 % of them; a busy machine may interrupt the rest
    finally:
        server.kill()
        server.wait()


class Waiting(LiveView):
    """A view whose viewer never comes; nothing of Rerun is started, so that nothing has to time out."""

    def _work(self, url: str) -> None:
        self._closing.wait()


def test_a_full_queue_drops_and_counts() -> None:
    view = Waiting(RIG, url=NOBODY, capacity=10)
    for i in range(1000):
        view.append(row(i))
    assert view.dropped == 990
    view.close()
    assert (view.shown, view.dropped) == (0, 1000)


def test_the_log_comes_first_and_its_errors_count() -> None:
    class Log:
        def __init__(self) -> None:
            self.rows: list[object] = []
            self.closed = False

        def append(self, values: object) -> None:
            if len(self.rows) == 3:
                raise WorkError("disk full")
            self.rows.append(values)

        def update(self, metadata: RunMetadata) -> None:
            self.metadata = metadata

        def close(self) -> None:
            self.closed = True

    log, view = Log(), Waiting(RIG, url=NOBODY, capacity=1)
    told: list[str] = []
    both = LogAndView(log, view, told.append)
    for i in range(3):
        both.append(row(i))
    with pytest.raises(WorkError, match="disk full"):
        both.append(row(3))
    both.update(RunMetadata(seed=1))
    both.close()
    assert len(log.rows) == 3 and log.closed and log.metadata.seed == 1
    assert view.dropped == 3
    assert told == ["the live view missed 3 rows; the log is written apart from it"]


def test_statistics_are_off_and_the_users_own_settings_untouched(monkeypatch: pytest.MonkeyPatch,
                                                                  tmp_path: pytest.TempPathFactory) -> None:
    theirs = tmp_path / "theirs"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(theirs))
    environment = viewer.private_environment()
    assert not viewer._statistics(environment)
    assert not theirs.exists()


def test_it_refuses_to_start_where_statistics_stay_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "_ask", lambda *_: '{"analytics_enabled": true}')
    with pytest.raises(WorkError, match="could not be switched off"):
        viewer.start(["--serve-grpc"])


def test_its_capacity_bounds_its_memory() -> None:
    assert live.CAPACITY * len(row(0)) * 32 < 8e6
