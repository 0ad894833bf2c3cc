"""The web viewer's page: served on 127.0.0.1 alone, under a policy that names no host outside."""

from __future__ import annotations

import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from station.view.web import LOOPBACK, policy, serve_page, without_links_outside


class Origin(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path not in ("/", "/re_viewer.js"):
            self.send_error(404)
            return
        body = b"<html>page</html>" if self.path == "/" else b"script"
        self.send_response(200)
        self.send_header("Content-Type", "text/html" if self.path == "/" else "text/javascript")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        return


@pytest.fixture
def origin() -> Iterator[int]:
    server = ThreadingHTTPServer((LOOPBACK, 0), Origin)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port
    server.shutdown()
    server.server_close()


def test_every_file_comes_with_the_policy(origin: int) -> None:
    with serve_page(origin, 4321) as address:
        assert address.startswith("http://127.0.0.1:") and "127.0.0.1%3A4321" in address
        for path, kind in (("", "text/html"), ("re_viewer.js", "text/javascript")):
            base = address.split("?")[0]
            with urllib.request.urlopen(base + path) as answer:
                assert answer.headers["Content-Security-Policy"] == policy(4321)
                assert answer.headers["Content-Type"] == kind
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(address.split("?")[0] + "elsewhere")


def test_the_policy_names_no_host_but_this_machine() -> None:
    hosts = [word for word in policy(9).split() if "." in word or "*" in word]
    assert hosts == [f"http://{LOOPBACK}:9;"]
    assert policy(9).startswith("default-src 'self';")


def test_no_other_address_of_this_machine_answers(origin: int) -> None:
    with serve_page(origin, 4321) as address, socket.socket() as other:
        port = int(address.split(":")[2].split("/")[0])
        other.settimeout(2.0)
        assert other.connect_ex(("127.0.0.2", port)) != 0


def test_links_to_hosts_outside_are_taken_out_of_the_page() -> None:
    page = (b'<link rel="icon" href="favicon.ico" /><link rel="preconnect" href="https://fonts.gstatic.com"/>'
            b'<link\n  href="//fonts.googleapis.com/css2"\n rel="stylesheet"\n/><a href="https://rerun.io">more</a>')
    assert without_links_outside(page) == (b'<link rel="icon" href="favicon.ico" />'
                                           b'<a href="https://rerun.io">more</a>')
