"""A real HTTP server on the loopback that misbehaves on request."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass
class Site:
    """What the server gives and how; `requests` records (path, Range, If-Range)."""

    files: dict[str, bytes] = field(default_factory=dict)
    ranges: bool = True
    etag: bool = True
    # Consumed one a request: send only this many bytes of the body, then hang up.
    cut_after: list[int] = field(default_factory=list)
    # Consumed one a request, before anything else: answer with this status.
    statuses: list[int] = field(default_factory=list)
    redirect_to: str = ""
    requests: list[tuple[str, str | None, str | None]] = field(default_factory=list)
    url: str = ""


@contextmanager
def serve() -> Generator[Site]:
    """Runs the server for the duration of the block."""
    site = Site()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted, condition = self.headers.get("Range"), self.headers.get("If-Range")
            site.requests.append((self.path, wanted, condition))
            if site.statuses:
                self.send_error(site.statuses.pop(0))
                return
            if site.redirect_to:
                self.send_response(302)
                self.send_header("Location", site.redirect_to)
                self.end_headers()
                return
            body = site.files.get(self.path)
            if body is None:
                self.send_error(404)
                return
            tag = f'"{hash(body)}"'
            start = 0
            if wanted and site.ranges and condition in (None, tag):
                start = int(wanted.removeprefix("bytes=").rstrip("-"))
                if start >= len(body):
                    self.send_error(416)
                    return
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
            else:
                self.send_response(200)
            if site.etag:
                self.send_header("ETag", tag)
            rest = body[start:]
            self.send_header("Content-Length", str(len(rest)))
            self.end_headers()
            self.wfile.write(rest[: site.cut_after.pop(0)] if site.cut_after else rest)
            self.close_connection = True

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - as in the base class
            """Keeps the test output quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    site.url = f"http://127.0.0.1:{server.server_port}"
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
