"""An S3 server of one's own on the loopback address, and a proxy before it that misbehaves as told."""

from __future__ import annotations

import io
import random
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

_BROKEN = b"<Error><Code>InternalError</Code><Message>made up</Message></Error>"
_BUSY = b"<Error><Code>SlowDown</Code><Message>made up</Message></Error>"
# It lists the folders of its package at every request, which takes half of the time of most.
_MOTO = """
import sys
from moto import backends, server
services = tuple(backends.list_of_moto_modules())
backends.list_of_moto_modules = lambda: services
server.main(sys.argv[1:])
"""
_PART_BYTES = 2**16
_HOP = ("connection", "keep-alive", "transfer-encoding", "content-length", "date", "server")


def free_port() -> int:
    """A free port of the loopback address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def moto_server(log: Path) -> Generator[int]:
    """moto's S3 server in a process of its own; its port."""
    port = free_port()
    with log.open("wb") as out:
        command = [sys.executable, "-c", _MOTO, "-H", "127.0.0.1", "-p", str(port)]
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    try:
        end_s = time.monotonic() + 120  # seconds of a busy machine
        while True:
            with suppress(OSError):
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            if process.poll() is not None or time.monotonic() > end_s:
                raise RuntimeError(f"moto did not start: {log.read_text()[-2000:]}")
            time.sleep(0.05)
        yield port
    finally:
        process.kill()
        process.wait()


def make_bucket(port: int, bucket: str) -> None:
    """Make a bucket on a server."""
    _put(f"http://127.0.0.1:{port}/{bucket}")


def make_locked_bucket(port: int, bucket: str) -> None:
    """Make a bucket with object lock, whose objects cannot be removed for a day."""
    address = f"http://127.0.0.1:{port}/{bucket}"
    _put(address, **{"x-amz-bucket-object-lock-enabled": "true"})
    rule = "<Rule><DefaultRetention><Mode>COMPLIANCE</Mode><Days>1</Days></DefaultRetention></Rule>"
    _put(
        f"{address}?object-lock",
        f"<ObjectLockConfiguration><ObjectLockEnabled>Enabled</ObjectLockEnabled>{rule}</ObjectLockConfiguration>",
    )


def _put(address: str, body: str = "", **headers: str) -> None:
    headers = {"Content-Type": "application/xml", **headers}
    request = urllib.request.Request(address, body.encode() or None, headers, method="PUT")
    urllib.request.urlopen(request, timeout=120).close()


def environment(port: int) -> dict[str, str]:
    """What tells a client to use the server at this port."""
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "AKIAMADEUP",
        "AWS_SECRET_ACCESS_KEY": "a-secret-that-nobody-may-see",
        "NO_PROXY": "127.0.0.1",
    }


@dataclass
class Faults:
    """What the proxy does to requests. Chances are drawn request by request; `script` comes first."""

    error: float = 0.0  # 500 or 503, and nothing was done
    lost_answer: float = 0.0  # done, and yet answered 500
    hold: float = 0.0  # no answer for `hold_s`; done or not, one time in two each
    cut: float = 0.0  # done; the answer breaks off in the middle of its body
    lost_creates: int = 0  # every so many-th create-only put, of commits and of others: done, answered 500
    hold_s: float = 0.0
    delay_s: float = 0.0  # before every request
    bytes_per_s: float = float("inf")  # of each connection, both ways
    seed: int = 0
    down_after: list[int] = field(default_factory=list[int])  # counts of requests after which all fails
    down_at_commits: list[int] = field(default_factory=list[int])  # done, not answered, then all fails
    down_for_s: float = 0.0  # after a commit: long enough for its writer to give up
    forgets_create_only: bool = False  # a store that knows no If-None-Match
    script: list[str] = field(default_factory=list[str])  # kinds for the next requests, in turn
    seen: Counter[str] = field(default_factory=Counter[str])
    down: bool = False

    def __post_init__(self) -> None:
        self._random, self._lock = random.Random(self.seed), threading.Lock()
        self._up_s = float("inf")

    def kind(self, path: str, creates: bool) -> str:
        """What becomes of the next request; `creates` is a put that must not replace."""
        with self._lock:
            self.seen["requests"] += 1
            if time.monotonic() >= self._up_s:
                self.down, self._up_s = False, float("inf")
            what = "commits" if "/commits/" in path else "creates"
            if creates and not self.down:
                self.seen[what] += 1
                if what == "commits" and self.down_at_commits and self.seen[what] > self.down_at_commits[0]:
                    self.down_at_commits.pop(0)
                    self.down, self._up_s = True, time.monotonic() + self.down_for_s
                    self.seen["lost_commit"] += 1
                    return "lost_answer"
            if self.down_after and not self.down and self.seen["requests"] > self.down_after[0]:
                self.down_after.pop(0)
                self.down = True
            if self.down:
                kind = "down"
            elif self.script:
                kind = self.script.pop(0)
            elif creates and self.lost_creates and self.seen[what] % self.lost_creates == 0:
                kind = "lost_answer"
            else:
                kind = self._drawn()
            self.seen[kind] += 1
            return kind

    def _drawn(self) -> str:
        at = self._random.random()
        for kind, chance in {
            "error": self.error,
            "lost_answer": self.lost_answer,
            "hold_before": self.hold / 2,
            "hold_after": self.hold / 2,
            "cut": self.cut,
        }.items():
            if at < chance:
                return kind
            at -= chance
        return "pass"


@contextmanager
def faulty_proxy(upstream: int, faults: Faults) -> Generator[int]:
    """A proxy before the server at port `upstream` that does what `faults` says; its port."""
    # One at a time: moto looks whether a key exists and writes it in two steps.
    conditional = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def handle_any(self) -> None:
            size = int(self.headers.get("content-length") or 0)
            body = b"".join(self._slowly(size, self.rfile.read))
            if len(body) < size:
                return self._break_off()
            kind = faults.kind(self.path, "if-none-match" in self.headers)
            time.sleep(faults.delay_s)
            if kind in ("error", "down"):
                status, text = random.choice([(500, _BROKEN), (503, _BUSY)])
                return self._answer(status, {}, text)
            if kind == "hold_before":
                time.sleep(faults.hold_s)
                return self._break_off()
            status, headers, answer = self._forward(body)
            if kind == "hold_after":
                time.sleep(faults.hold_s)
                return self._break_off()
            if kind == "lost_answer":
                return self._answer(500, {}, _BROKEN)
            if kind == "cut" and self.command != "HEAD" and len(answer) > 1:
                self._head(status, headers, len(answer))
                self.wfile.write(answer[: len(answer) // 2])
                return self._break_off()
            return self._answer(status, headers, answer)

        do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = handle_any

        def _forward(self, body: bytes) -> tuple[int, Mapping[str, str], bytes]:
            headers = {k: v for k, v in self.headers.items() if k.lower() not in _HOP}
            if "x-amz-checksum-sha256" in self.headers:  # enough for S3, not for moto
                headers["x-amz-sdk-checksum-algorithm"] = "SHA256"
            if faults.forgets_create_only:
                headers = {k: v for k, v in headers.items() if k.lower() != "if-none-match"}
            if "if-none-match" in self.headers:
                with conditional:
                    return self._upstream(headers, body)
            return self._upstream(headers, body)

        def _upstream(self, headers: Mapping[str, str], body: bytes) -> tuple[int, Mapping[str, str], bytes]:
            connection = HTTPConnection("127.0.0.1", upstream, timeout=60)
            try:
                connection.request(self.command, self.path, body, dict(headers))
                answer = connection.getresponse()
                data = answer.read()
                kept = {k: v for k, v in answer.getheaders() if k.lower() not in _HOP}
                if self.command == "HEAD":
                    kept["Content-Length"] = answer.getheader("content-length") or "0"
                return answer.status, kept, data
            except (OSError, HTTPException):
                return 503, {}, _BUSY
            finally:
                connection.close()

        def _head(self, status: int, headers: Mapping[str, str], size: int) -> None:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            if "Content-Length" not in headers:
                self.send_header("Content-Length", str(size))
            self.end_headers()

        def _answer(self, status: int, headers: Mapping[str, str], data: bytes) -> None:
            with suppress(OSError):  # whoever asked may have given up
                self._head(status, headers, len(data))
                if self.command != "HEAD":
                    file = io.BytesIO(data)
                    for _ in self._slowly(len(data), lambda size: self.wfile.write(file.read(size))):
                        pass

        def _slowly(self, size: int, move: Callable[[int], Any]) -> Iterator[Any]:
            for at in range(0, size, _PART_BYTES):
                part = min(_PART_BYTES, size - at)
                time.sleep(part / faults.bytes_per_s)
                yield move(part)

        def _break_off(self) -> None:
            self.close_connection = True
            with suppress(OSError):
                self.connection.shutdown(socket.SHUT_RDWR)

        def log_message(self, *_: Any) -> None:
            return

    class Server(ThreadingHTTPServer):
        daemon_threads = True
        request_queue_size = 128

        def handle_error(self, *_: Any) -> None:
            return  # a client that went away

    server = Server(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()
