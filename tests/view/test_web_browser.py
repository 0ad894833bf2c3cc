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
from urllib.parse import urlsplit

import psutil
import pytest

from station.rig import load_rig
from station.view import viewer
from station.view.recording import write_recording
from station.view.web import LOOPBACK, serve_page
from tests.view import made
from tests.view.browser import SOFTWARE_GL, chromium

RIG = load_rig("sflr")
CHROMIUMS_OWN = ("update.googleapis.com", "content-autofill.googleapis.com", ".google.com", ".gvt1.com")
DRAWN_WITHIN = 120.0
"""Seconds; a processor draws what a graphics card would."""


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


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    """Rerun's server with a recording: the process, the port of its page and that of its data."""
    folder = tmp_path_factory.mktemp("served")
    recording = folder / "two.rrd"
    write_recording(recording, made.comparisons()[:2], RIG)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewer.platformdirs, "user_config_dir", lambda *_, **__: str(folder / "settings"))
        page, data = viewer.free_port(), viewer.free_port()
        process = viewer.start(["--serve-web", "--web-viewer-port", str(page), str(recording)], data)
    yield process, page, data
    process.kill()
    process.wait()


def colours(picture: bytes) -> int:
    """How many colours a picture has."""
    from matplotlib.image import imread

    pixels = (imread(io.BytesIO(picture), format="png")[..., :3] * 255.0).round().astype(int)
    return len(set((pixels[..., 0] << 16 | pixels[..., 1] << 8 | pixels[..., 2]).ravel().tolist()))


def test_a_picture_of_one_colour_counts_as_blank():
    from matplotlib.image import imsave

    blank = io.BytesIO()
    imsave(blank, [[[0.1, 0.2, 0.3]] * 8] * 8, format="png")
    assert colours(blank.getvalue()) == 1


def test_the_viewer_draws_the_recording_and_nothing_leaves_this_machine(served, outside):
    _, page, data = served
    proxied = [f"--proxy-server=http://{LOOPBACK}:{outside.port}", *SOFTWARE_GL]
    with serve_page(page, data) as address, chromium(proxied) as browser:
        tab = browser.new_page(viewport={"width": 1000, "height": 700})
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
