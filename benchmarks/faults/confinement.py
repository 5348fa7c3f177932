"""Cost of opening a run's files without following links, in microseconds per call.

python -m benchmarks.faults.confinement [--rounds 500]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable

import obstore
from obstore.store import LocalStore

from datagen.schemas.storage import open_storage

KEY = "shards/000001/000001-abcd-000001/points_m/c.0.0"


def microseconds(call: Callable[[], object], rounds: int) -> float:
    """The smallest mean over rounds of ten calls: that of an undisturbed round."""
    least = float("inf")
    for _ in range(rounds):
        start_s = time.perf_counter()
        for _ in range(10):
            call()
        least = min(least, time.perf_counter() - start_s)
    return least / 10 * 1e6


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=500)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as folder:
        storage, store = open_storage(folder), LocalStore(folder)
        storage.put(KEY, b"x" * 1000)
        path = storage.folder / KEY if storage.folder else None
        assert path is not None
        rows: dict[str, Callable[[], object]] = {
            "read, by path": path.read_bytes,
            "read, confined": lambda: storage.get(KEY, 1000),
            "read, obstore's local store": lambda: bytes(obstore.get(store, KEY).bytes()),
            "write, confined": lambda: storage.put(KEY, b"x" * 1000),
            "write, obstore's local store": lambda: obstore.put(store, KEY, b"x" * 1000, use_multipart=False),
        }
        for name, call in rows.items():
            print(f"{name:30} {microseconds(call, rounds):8.1f} us")


if __name__ == "__main__":
    main()
