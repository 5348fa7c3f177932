"""Storage on S3: the same verbs, one winner also behind a store that fails, errors of one line."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from obstore.exceptions import GenericError

from datagen.schemas.errors import InputError
from datagen.schemas.storage import Storage, open_storage, remote_objects
from datagen.schemas.storage.errors import StoreUnavailable, repeated_for_minutes, store_trouble
from tests.s3_servers import Faults, environment, faulty_proxy

Behind = Callable[[Faults], AbstractContextManager[Storage]]


@pytest.fixture
def behind(bucket: str, s3_port: int, monkeypatch: pytest.MonkeyPatch) -> Behind:
    """A storage behind a proxy with faults."""

    @contextmanager
    def open_behind(faults: Faults) -> Generator[Storage]:
        with faulty_proxy(s3_port, faults) as port:
            for name, value in environment(port).items():
                monkeypatch.setenv(name, value)
            monkeypatch.setenv("DATAGEN_STORE_TIMEOUT_S", "2")
            yield open_storage(f"{bucket}/runs/a", probe=False)

    return open_behind


@pytest.mark.parametrize("kind", ["disk", "s3"])
def test_of_racing_writers_exactly_one_wins_and_its_bytes_stay(kind: str, behind: Behind, tmp_path: Path):
    with behind(Faults()) as remote:
        s = open_storage(tmp_path) if kind == "disk" else remote
        for round_ in range(8):
            barrier = threading.Barrier(4)

            def race(me: int, key: str = f"c/{round_}", barrier: threading.Barrier = barrier) -> bool:
                barrier.wait()
                return s.put_new(key, b"%d" % me * 1000)

            with ThreadPoolExecutor(4) as pool:
                won = list(pool.map(race, range(4)))
            assert sum(won) == 1
            assert s.get(f"c/{round_}", 5000) == b"%d" % won.index(True) * 1000
        assert sorted(file.key for file in s.list("")) == [f"c/{i}" for i in range(8)]


def test_what_was_done_and_answered_by_an_error_is_done(behind: Behind):
    faults = Faults(hold_s=3.0)
    with behind(faults) as s:
        # What happens to the request of the first writer, and to that of one who comes too late.
        for i, (first, second) in enumerate([("lost_answer", "hold_before"), ("hold_after", "error")]):
            faults.script = [first]
            assert s.put_new(f"c/{i}", b"ours")
            assert s.put_new(f"c/{i}", b"ours")
            faults.script = [second]
            assert not s.put_new(f"c/{i}", b"theirs")
            assert s.get(f"c/{i}", 9) == b"ours"
        for verb in (lambda: s.put("p", b"1"), lambda: s.delete(["p", "none"]), lambda: s.exists("c/0")):
            faults.script = ["lost_answer"]
            verb()
        assert not s.exists("p")


def test_answers_that_break_off_are_asked_for_again(behind: Behind):
    faults = Faults()
    with behind(faults) as s:
        for i in range(20):
            s.put(f"k/{i}", b"%d" % i * 1000)
        faults.script = ["cut", "cut"]
        assert s.get("k/7", 2000) == b"7" * 1000
        faults.script = ["cut", "error", "cut"]
        assert len(list(s.list("k"))) == 20
        faults.script = ["cut", "error", "lost_answer"] * 4
        assert len(dict(s.get_many([f"k/{i}" for i in range(20)], 2000))) == 20
        for start in (10, -500):
            faults.script = ["cut", "error", "cut"]
            assert s.get_range("k/7", start, 500) == b"7" * 500


def test_a_large_object_on_a_slow_line_is_not_silence(behind: Behind):
    data = bytes(2_000_000)
    with behind(Faults(bytes_per_s=600_000)) as s:
        assert s.put_new("c/0", data)
        s.put("a", data)
        assert s.get("c/0", len(data)) == s.get("a", len(data)) == data


def test_a_store_that_ignores_create_only_is_refused(behind: Behind, bucket: str):
    with behind(Faults(forgets_create_only=True)):
        with pytest.raises(InputError, match="does not support create-only writes") as e:
            open_storage(f"{bucket}/runs/a")
        assert bucket in str(e.value)
        assert list(open_storage(bucket, probe=False).list("")) == []


def test_a_job_waits_longer_for_the_store_than_another_command(
    behind: Behind, monkeypatch: pytest.MonkeyPatch
):
    faults, told = Faults(), list[StoreUnavailable]()
    monkeypatch.setattr(remote_objects, "PATIENCE", 0.0)
    with behind(faults) as s:
        s.put("a", b"1")
        faults.script = ["error"] * 4
        with pytest.raises(StoreUnavailable):
            s.get("a", 9)  # two tries
        assert faults.script == ["error"] * 2
        faults.script = ["error"] * 6
        with repeated_for_minutes(told.append):
            assert s.get("a", 9) == b"1"
        assert len(told) == 1 and "the store responds 50" in str(told[0])
        faults.script = ["error"] * 2
        with pytest.raises(StoreUnavailable):
            s.get("a", 9)


@contextmanager
def answering(answer: bytes | None) -> Generator[int]:
    """A port where every connection gets this answer; none for None, and no connection for b""."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port, held = server.getsockname()[1], list[socket.socket]()
        if answer == b"":
            server.close()
            yield port
            return

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                held.append(connection)
                if answer is not None:
                    connection.recv(65536)
                    connection.sendall(answer)
                    connection.close()

        threading.Thread(target=serve, daemon=True).start()
        yield port
        server.shutdown(socket.SHUT_RDWR)


def answer(status: str, code: str, message: str = "the key AKIAMADEUP is bad") -> bytes:
    body = f"<Error><Code>{code}</Code><Message>{message}</Message></Error>".encode()
    return f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body


_LOCKED = "Content-MD5 OR x-amz-checksum- HTTP header is required for Put Object requests with Object Lock"
TROUBLE: tuple[tuple[bytes | tuple[str, ...] | None, str], ...] = (
    (("403 Forbidden", "AccessDenied"), "access denied (AccessDenied). Allow AWS_ACCESS_KEY_ID"),
    (("403 Forbidden", "InvalidAccessKeyId"), "access denied (InvalidAccessKeyId). Check AWS_ACC"),
    (("403 Forbidden", "SignatureDoesNotMatch"), "(SignatureDoesNotMatch). Check AWS_SECRET_ACC"),
    (("400 Bad Request", "ExpiredToken"), "credentials have expired (ExpiredToken). Set new AWS_"),
    (("403 Forbidden", "RequestTimeTooSkewed"), "(RequestTimeTooSkewed). Set the clock"),
    (("404 Not Found", "NoSuchBucket"), "no such bucket. Create the bucket"),
    (("301 Moved", "PermanentRedirect"), "the bucket is in another region. Set AWS_REGION"),
    (("400 Bad Request", "AuthorizationHeaderMalformed"), "is in another region (Authorization"),
    (("507 Insufficient Storage", "XMinioStorageFull"), "the store is full (XMinioStorageFull). Free"),
    (("403 Forbidden", "Unheard"), "access denied (Unheard). Check AWS_ACCESS_KEY_ID"),
    (("400 Bad Request", "InvalidRequest", _LOCKED), "(object lock). Set AWS_CHECKSUM_ALGORITHM=SHA256"),
    (("501 Not Implemented", "NotImplemented"), "the store refuses (501 NotImplemented)"),
    (("503 Slow Down", "SlowDown"), "the store responds 503 SlowDown. Wait until"),
    (b"SSH-2.0-OpenSSH\r\n\r\n", "is not that of an S3 store. Check that AWS_ENDPOINT_URL"),
    (b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello", "is not that of an S3 store"),
    (None, "the store does not respond in time. Check the network, or raise"),
    (b"", "the store cannot be reached (the connection fails). Check AWS_ENDPOINT_URL"),
)


@pytest.mark.parametrize(("reply", "problem"), TROUBLE)
def test_every_trouble_is_one_line_with_its_fix(
    reply: bytes | tuple[str, ...] | None, problem: str, monkeypatch: pytest.MonkeyPatch
):
    with answering(answer(*reply) if isinstance(reply, tuple) else reply) as port:
        for name, value in environment(port).items():
            monkeypatch.setenv(name, value)
        # Whoever answers has a second for it: a busy machine may not find the time in less.
        monkeypatch.setenv("DATAGEN_STORE_TIMEOUT_S", "1" if reply else "0.3")
        s = open_storage("s3://bucket/runs/a", probe=False)
        for verb in (lambda: s.put_new("commits/7", b"x"), lambda: list(s.list("commits"))):
            with pytest.raises(StoreUnavailable) as e:
                verb()
            told = str(e.value)
            assert problem in told and told.startswith("s3://bucket/runs/a/commits")
            assert not any(word in told for word in ("AKIA", "secret", "127.0.0.1"))


def test_what_is_told_of_an_answer_does_not_hang_on_names():
    told = "Error performing GET http://host/redirect/dns error/k - Server returned non-2xx status code: "
    trouble = store_trouble(GenericError(told + "503 Service Unavailable: <Error><Code>SlowDown</Code>"))
    assert (trouble.problem, trouble.is_transient) == ("the store responds 503 SlowDown", True)
    asked = "Error performing PUT http://169.254.169.254/latest/api/token - "
    trouble = store_trouble(GenericError(asked + "HTTP error: error sending request"))
    assert (trouble.problem, trouble.is_transient) == ("no credentials are set", False)
    trouble = store_trouble(GenericError(asked + "Server returned non-2xx status code: 503 Busy"))
    assert trouble.is_transient


def test_addresses_and_settings_that_cannot_be_used(bucket: str, monkeypatch: pytest.MonkeyPatch):
    for place, problem in [
        ("s3://", "does not name a bucket"),
        ("s3:///x", "does not name a bucket"),
        ("s3://B_/x", "does not name a bucket"),
        ("s3://key:secret@bucket/x", "has more than a bucket and a prefix"),
        ("s3://bucket/x?secret=1", "has more than a bucket and a prefix"),
        ("s3://bucket/../x", "has an empty part, or a part of dots"),
        ("s3://bucket/a//b", "has an empty part, or a part of dots"),
        ("gs://bucket/x", "neither a folder nor an s3:// address"),
        ("s3:/bucket/x", "does not name a bucket. Give s3://bucket/prefix"),
    ]:
        with pytest.raises(InputError, match=problem) as e:
            open_storage(place)
        assert "secret" not in str(e.value)
    for name, value, problem in [
        ("DATAGEN_STORE_TIMEOUT_S", "soon", "is not a valid timeout"),
        ("AWS_ALLOW_HTTP", "", r"is not encrypted \(http\). Set AWS_ALLOW_HTTP=true"),
        ("AWS_ENDPOINT_URL", "not an address", "is not the address of a store"),
        ("AWS_ENDPOINT_URL", "http://key:secret@host", "is not the address of a store"),
        ("AWS_ENDPOINT_URL", "ftp://host", "is not the address of a store"),
        ("AWS_ENDPOINT_URL", "http://[::", "is not the address of a store"),
    ]:
        with monkeypatch.context() as m:
            m.setenv(name, value)
            with pytest.raises(InputError, match=problem) as e:
                open_storage(f"{bucket}/x")
            assert name in str(e.value) and "secret" not in str(e.value)
