"""The web viewer's page, served by Station with a policy that lets the browser talk to 127.0.0.1 alone.

Rerun's own page asks hosts outside (fonts, its examples, its latest release, usage statistics) even with statistics
switched off.  Here each of its files passes through with a Content-Security-Policy, by which the browser refuses
those requests before they leave.  Links to hosts outside are taken out of the page besides: a policy need not hold for
a ``preconnect``, by which a browser looks up a host ahead of time.
"""

from __future__ import annotations

import re
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, urlsplit

from station.errors import WorkError

LOOPBACK = "127.0.0.1"
STARTS_WITHIN = 20.0
"""Seconds that Rerun's server may take to answer first."""
_OUTSIDE = re.compile(rb"<link\b[^>]*\bhref\s*=\s*[\"']?\s*(?:https?:)?//[^>]*>", re.IGNORECASE)


def policy(data_port: int) -> str:
    """Own files, scripts and WebAssembly; connections to the recording's server; nothing else."""
    return ("default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval'; "
            "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self' blob:; "
            f"connect-src 'self' http://{LOOPBACK}:{data_port}; base-uri 'none'; form-action 'none'")


def without_links_outside(page: bytes) -> bytes:
    """The page without its ``<link>`` elements that name a host: fonts, and hosts to connect to ahead of time."""
    return _OUTSIDE.sub(b"", page)


@contextmanager
def serve_page(page_port: int, data_port: int) -> Iterator[str]:
    """Serve the page of Rerun's server at ``page_port``; yields the address to open."""
    source = f"http://{LOOPBACK}:{page_port}"
    _wait_for(source)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = urlsplit(self.path).path
            try:
                with urllib.request.urlopen(source + quote(path), timeout=30) as answer:
                    body, kind = answer.read(), answer.headers.get("Content-Type", "application/octet-stream")
                    encoding = answer.headers.get("Content-Encoding")
            except urllib.error.URLError:
                self.send_error(404)
                return
            if kind.startswith("text/html") and not encoding:
                body = without_links_outside(body)
            self.send_response(200)
            self.send_header("Content-Type", kind)
            if encoding:
                self.send_header("Content-Encoding", encoding)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", policy(data_port))
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("X-DNS-Prefetch-Control", "off")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            return

    server = ThreadingHTTPServer((LOOPBACK, 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    recording = quote(f"rerun+http://{LOOPBACK}:{data_port}/proxy", safe="")
    try:
        yield f"http://{LOOPBACK}:{server.server_port}/?url={recording}"
    finally:
        server.shutdown()
        server.server_close()


def _wait_for(address: str) -> None:
    limit = time.monotonic() + STARTS_WITHIN
    while True:
        try:
            with urllib.request.urlopen(address, timeout=2):
                return
        except OSError as error:
            if time.monotonic() > limit:
                raise WorkError(f"{address}: the viewer's server does not answer ({error})") from None
            time.sleep(0.1)
