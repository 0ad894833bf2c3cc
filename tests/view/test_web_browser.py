"""`station view --web` in a real browser: the recording is drawn, and nothing is asked of a host outside.

The browser's proxy is a listener of this test, which every address but 127.0.0.1 goes through: what leaves the browser
is seen there, whatever the browser itself says of it.  What Chromium asks its maker is left out.
"""

from __future__ import annotations

import contextlib
import io
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest

from station.control.compensators import Compensator
from station.control.named import NAMED
from station.control.references import step
from station.device.port import open_port
from station.loop.run_test import run_test
from station.rig import load_rig
from station.runs.blueprint import COLOURS
from station.runs.mcap_log import McapLogWriter
from station.view import viewer
from station.view.recording import write_recording
from station.view.web import LOOPBACK, serve_page
from tests.view import made
from tests.view.browser import SOFTWARE_GL, chromium

RIG = load_rig("sflr")
CHROMIUMS_OWN = ("update.googleapis.com", "content-autofill.googleapis.com", ".google.com", ".gvt1.com")
DRAWN_WITHIN = 120.0
"""Seconds; a processor draws what a graphics card would."""
SMALL = {"width": 700, "height": 560}
"""Of the page, pixels: it has fewer to draw."""


class Outside:
    """A proxy that answers nobody and keeps the first line of what it is asked."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self._server = socket.create_server((LOOPBACK, 0))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                line, _ = self._server.accept()
                with line, contextlib.suppress(OSError):
                    line.settimeout(2.0)
                    self.asked.append(line.recv(4096).split(b"\r\n")[0].decode("latin-1"))

    @property
    def hosts(self) -> set[str]:
        """Whom the page asked."""
        hosts = {urlsplit(words[1] if "://" in words[1] else f"//{words[1]}").hostname or line
                 for line in self.asked if len(words := line.split()) > 1}
        return {host for host in hosts if not host.endswith(CHROMIUMS_OWN)}

    def close(self) -> None:
        self._server.close()


@pytest.fixture
def outside() -> Iterator[Outside]:
    proxy = Outside()
    yield proxy
    proxy.close()


@contextlib.contextmanager
def serving(*files: Path) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    """Rerun's server with files: the process, the port of its page and that of its data."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewer.platformdirs, "user_config_dir", lambda *_, **__: str(files[0].parent / "settings"))
        page, data = viewer.free_port(), viewer.free_port()
        process = viewer.start(["--serve-web", "--web-viewer-port", str(page), *map(str, files)], data)
    yield process, page, data
    process.kill()
    process.wait()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    """The server with a recording."""
    recording = tmp_path_factory.mktemp("served") / "two.rrd"
    write_recording(recording, made.comparisons()[:2], RIG)
    with serving(recording) as running:
        yield running


def pixels(picture: bytes) -> np.ndarray:
    """A picture's colours as whole numbers, 0xRRGGBB."""
    from matplotlib.image import imread

    found = (imread(io.BytesIO(picture), format="png")[..., :3] * 255.0).round().astype(int)
    return found[..., 0] << 16 | found[..., 1] << 8 | found[..., 2]


def colours(picture: bytes) -> int:
    """How many colours a picture has."""
    return len(np.unique(pixels(picture)))


def test_a_picture_of_one_colour_counts_as_blank():
    from matplotlib.image import imsave

    blank = io.BytesIO()
    imsave(blank, [[[0.1, 0.2, 0.3]] * 8] * 8, format="png")
    assert colours(blank.getvalue()) == 1


@pytest.mark.long
def test_the_viewer_draws_the_recording_and_nothing_leaves_this_machine(served, outside):
    _, page, data = served
    proxied = [f"--proxy-server=http://{LOOPBACK}:{outside.port}", *SOFTWARE_GL]
    with serve_page(page, data) as address, chromium(proxied) as browser:
        tab = browser.new_page(viewport=SMALL)
        answered, refused = [], []
        tab.on("response", lambda answer: answered.append(answer.url))
        tab.on("console", lambda m: refused.append(m.text) if "Content Security Policy" in m.text else None)
        tab.goto(f"{address}&renderer=webgl")
        canvas = tab.wait_for_selector("canvas.visible", timeout=1e3 * DRAWN_WITHIN)
        until = time.monotonic() + DRAWN_WITHIN
        drawn = 0
        while drawn < 200 and time.monotonic() < until:
            tab.wait_for_timeout(2000)
            drawn = colours(canvas.screenshot(timeout=120_000))
        while not any("ReadMessages" in url for url in answered) and time.monotonic() < until:
            tab.wait_for_timeout(500)
    assert drawn >= 200
    assert {url.split("/")[2] for url in answered} == {f"{LOOPBACK}:{data}", address.split("/")[2]}
    assert any("ReadMessages" in url for url in answered)       # the recording's own server was asked
    assert refused, "Rerun's viewer asked nobody: the policy was not put to the test"
    assert outside.hosts == set()


@pytest.mark.long
def test_a_log_is_drawn_in_its_blueprints_colours(tmp_path):
    """What `rerun RUN.mcap RUN.rbl` shows: a line of its own for each column, which the log alone does not have."""
    log = tmp_path / "log.mcap"
    compensator = Compensator.from_spec(NAMED["lead"], RIG.sample_rate, RIG.command_limit)
    with open_port("sim://sflr?noise=1&seed=1") as port:
        run_test(port, RIG, compensator, step(RIG.sample_rate), log_sink=partial(McapLogWriter, log))
    wanted = {COLOURS[column] >> 8 for column in ("encoder", "command", "accel", "latency")}
    lines: set[int] = set()
    with serving(log, log.with_suffix(".rbl")) as (_, page, data), serve_page(page, data) as address, \
            chromium(SOFTWARE_GL) as browser:
        tab = browser.new_page(viewport=SMALL)
        tab.goto(f"{address}&renderer=webgl")
        canvas = tab.wait_for_selector("canvas.visible", timeout=1e3 * DRAWN_WITHIN)
        until = time.monotonic() + DRAWN_WITHIN
        while not wanted <= lines and time.monotonic() < until:
            tab.wait_for_timeout(2000)
            lines = set(np.unique(pixels(canvas.screenshot(timeout=120_000))).tolist())
    assert wanted <= lines


@pytest.mark.long
def test_reruns_own_page_does_ask_outside(served, outside):
    """The control: without Station's page the same listener hears of it."""
    _, page, _ = served
    with serve_page(page, 9), chromium([f"--proxy-server=http://{LOOPBACK}:{outside.port}", *SOFTWARE_GL]) as browser:
        tab = browser.new_page()
        tab.goto(f"http://{LOOPBACK}:{page}/", wait_until="commit")
        until = time.monotonic() + 60.0
        while not outside.hosts and time.monotonic() < until:
            tab.wait_for_timeout(200)
    assert outside.hosts & {"fonts.googleapis.com", "fonts.gstatic.com"}


def test_reruns_servers_listen_on_this_machine_alone(served):
    process, page, data = served
    with serve_page(page, data):
        listening = {connection.laddr.ip for connection in psutil.Process(process.pid).net_connections("inet")
                     if connection.status == psutil.CONN_LISTEN}
    assert listening == {LOOPBACK}
