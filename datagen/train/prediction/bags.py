"""Messages of recordings of ROS 2, MCAP files and rosbag2 folders, read within bounded memory."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import apsw
from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError, storage_mcap
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import open_regular

zstd: Any = vars(storage_mcap)["zstd"]  # of the standard library or its backport
STORE = get_typestore(Stores.ROS2_JAZZY)
# What libraries raise for damaged files.
DAMAGED = (
    *(ReaderError, SerdeError, apsw.Error, struct.error, zstd.ZstdError, ArithmeticError),
    *(AssertionError, EOFError, LookupError, MemoryError, OSError, RuntimeError, SyntaxError, TypeError),
    ValueError,
)
FIX = "Name an .mcap, .db3 or folder that `ros2 bag info` reads; `mcap recover` repairs a file that was cut"
OTHER_FRAME = "Choose another frame with --at, or record it again"
_ENDINGS = (".mcap", ".db3")
_ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_BYTES = 256 * 2**20  # of one chunk or message
_NEAR_NS = 2 * 10**9


def _unpacked(decompressor: Any, data: bytes, most_bytes: int = _MOST_BYTES) -> bytes:
    """What is packed; ReaderError for more bytes than expected, before memory is taken for them."""
    if most_bytes <= _MOST_BYTES:
        raw: bytes = decompressor.decompress(data, most_bytes + 1)
        if len(raw) <= most_bytes:
            return raw
    raise ReaderError(f"a chunk or message unpacks to more than {min(most_bytes, _MOST_BYTES):,} bytes")


# rosbags itself unpacks chunks of any size.
storage_mcap.DECOMPRESSORS.update(
    zstd=lambda data, size: _unpacked(zstd.ZstdDecompressor(), data, size),
    lz4=lambda data, size: _unpacked(LZ4FrameDecompressor(), data, size),
)
# Definitions in files are not used, and rosbags refuses a file that has one of another kind than ROS 2.
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
storage_mcap.get_msgdef = lambda schema: _NO_DEFINITION


class Bag:
    """A recording: `types` of its topics, and its start and end (ns). Files are open until `stack` closes."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        files = sorted(p for p in path.iterdir() if p.suffix in _ENDINGS) if path.is_dir() else [path]
        if not files or files[0].suffix not in _ENDINGS:
            packed = path.is_dir() and any(path.glob("*.zst"))
            fix = "Unpack its files first: zstd -d *.zst" if packed else FIX
            raise self.error("--bag", "is not a recording of ROS 2", fix)
        self._parts: list[tuple[Any, list[list[Any]]]] = []
        for file in files:
            with open_regular(file, 2**50, FIX) as opened:
                size = opened.seek(0, io.SEEK_END)
            reader = Reader(file)
            reader.open()
            stack.callback(reader.close)
            storage: Any = reader.storage
            chunks = getattr(storage, "chunks", [])
            if file.suffix == ".mcap" and not chunks and size > _MOST_BYTES:
                raise self.error(file.name, "has no index", "Write it again: mcap recover FILE -o NEW")
            if any(max(chunk.compressed_size, chunk.uncompressed_size) > _MOST_BYTES for chunk in chunks):
                raise ReaderError(f"a chunk has more than {_MOST_BYTES:,} bytes")
            self._parts.append((storage, [[chunk] for chunk in chunks] or [[]]))
        found = [each.metadata for each, _ in self._parts if each.metadata.message_count]
        self.start_ns: int = min((each.start_time for each in found), default=0)
        self.end_ns: int = max((each.end_time for each in found), default=0)
        self.types: dict[str, str] = {c.topic: c.msgtype for s, _ in self._parts for c in s.connections}

    def error(self, field: str, problem: str, fix: str = "") -> InputError:
        """The error of a topic or another part of it; the fix may be to choose another of its topics."""
        shown = [f"{topic} ({kind})" for topic, kind in sorted(self.types.items())] if not fix else []
        listed = ", ".join([*shown[:20], *(["..."] if len(shown) > 20 else [])])[:1200] or "no topics"
        return InputError(
            self.path, field, problem, fix or f"Choose with --topic ROLE=TOPIC; it has {listed}"
        )

    def messages(
        self, topics: Sequence[str], window_ns: tuple[int, int] | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording (ns) and data, not in order: one chunk is in memory at a time."""
        start, stop = window_ns or (None, None)
        for storage, parts in self._parts:
            if not (chosen := [c for c in storage.connections if c.topic in topics]):
                continue
            for part in parts:
                storage.chunks = part
                for connection, time_ns, data in storage.messages(chosen, start, stop):
                    if data[:4] == _ZSTD:
                        data = _unpacked(zstd.ZstdDecompressor(), data)
                    yield connection.topic, time_ns, data

    def last(self, topic: str, until_ns: int) -> Any:
        """The last message of a topic until a time, else the first after it."""
        for window in windows(until_ns):
            best: tuple[tuple[bool, int], bytes] | None = None
            for _, time_ns, data in self.messages([topic], window):
                rank = (time_ns <= until_ns, time_ns if time_ns <= until_ns else -time_ns)
                best = (rank, data) if best is None or rank > best[0] else best
            if best is not None:
                return self.read(topic, best[1])
        raise self.error(topic, "has no message")

    def read(self, topic: str, data: bytes) -> Any:
        """A message, by the standard definition of its type. InputError for one that is not whole."""
        try:
            return STORE.deserialize_cdr(data, self.types[topic])
        except DAMAGED as error:
            raise self.error(topic, f"a message is damaged ({type(error).__name__})", OTHER_FRAME) from None


def windows(time_ns: int) -> tuple[tuple[int, int] | None, ...]:
    """Around a time, then all: long recordings are read whole only where need be."""
    return (max(time_ns - _NEAR_NS, 0), time_ns + _NEAR_NS), None


def stamp_ns(header: Any) -> int:
    """The time (ns) of a std_msgs/Header."""
    return header.stamp.sec * 10**9 + header.stamp.nanosec
