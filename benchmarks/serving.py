r"""Requests a second that `datagen serve` answers, their latency, and what they cost, as a table.

    python -m benchmarks.serving FRAME [--map map.yaml] [--robot fetch] [--cores 1 2] [--seconds 60]

FRAME is a frame's folder with a pose and a mask. The service may use the first of this process's cores, and
has one worker process on each. Two clients a core ask again as soon as they are answered. Requests are of
three kinds: `frame`, with another frame each (noise of 1 mm on the depth); `target`, clicks into one frame;
`arrival`, one frame and target with several arrival errors. Memory (unshared) and CPU are those of all
processes of the service, memory at the start after eight requests a core.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from itertools import cycle
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import numpy as np
import psutil

from datagen.train.prediction import read_place

PORT, FRAMES, TARGETS = 8790, 24, 12
Call = tuple[bytes, str]  # a body and a query


def main() -> None:
    """Start the service on each number of cores, ask it, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("frame", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--robot", default="fetch")
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--kinds", nargs="+", default=["frame", "target", "arrival"])
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    print(f"{'':8} cores  requests/s  p50 s  p95 s  CPU s a request  memory at start and end")
    for cores in options.cores:
        for kind in options.kinds:
            _measure(kind, cores, options)


def _measure(kind: str, cores: int, options: argparse.Namespace) -> None:
    words = ["serve", "--robot", options.robot, "--port", str(PORT)]
    words += ["--map", str(options.map)] if options.map else []
    usable = sorted(os.sched_getaffinity(0))[:cores]
    code = (
        f"import os, sys; os.sched_setaffinity(0, {usable}); from datagen.cli import main; sys.exit(main())"
    )
    with subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.DEVNULL) as service:
        try:
            _wait()
            calls = list(_calls(kind, options.frame))
            for _, call in zip(range(8 * cores), cycle(calls)):
                _ask(call)
            processes = [psutil.Process(service.pid), *psutil.Process(service.pid).children(recursive=True)]
            memory, cpu_s, begun_s = _memory(processes), _cpu_s(processes), time.monotonic()
            took_s = _load(calls, 2 * cores, options.seconds)
            passed_s, cpu_s = time.monotonic() - begun_s, _cpu_s(processes) - cpu_s
            p50, p95 = np.percentile(took_s, [50, 95])
            print(
                f"{kind:8} {cores:5}  {len(took_s) / passed_s:10.1f}  {p50:5.2f}  {p95:5.2f}",
                f" {cpu_s / len(took_s):15.3f}  {memory:.0f} and {_memory(processes):.0f} MiB",
                flush=True,
            )
        finally:
            service.terminate()


def _load(calls: list[Call], clients: int, seconds: float) -> list[float]:
    """Seconds that each request took."""
    ends_s, following, lock = time.monotonic() + seconds, cycle(calls), threading.Lock()

    def client(_: int) -> list[float]:
        took_s: list[float] = []
        while (begun_s := time.monotonic()) < ends_s:
            with lock:
                call = next(following)
            _ask(call)
            took_s.append(time.monotonic() - begun_s)
        return took_s

    with ThreadPoolExecutor(clients) as pool:
        return [each for took_s in pool.map(client, range(clients)) for each in took_s]


def _calls(kind: str, place: Path) -> Iterator[Call]:
    frame = read_place(place)
    assert frame.image is not None and frame.image.mask is not None and frame.T_world_camera is not None
    image, p, rng = frame.image, frame.image.pinhole, np.random.default_rng(0)
    arrays: dict[str, Any] = {
        "rgb": image.rgb,
        "depth": np.rint(image.depth_m * 1000).astype(np.uint16),
        "intrinsics": np.array([p.fx_px, p.fy_px, p.cx_px, p.cy_px]),
        "T_world_camera": frame.T_world_camera,
    }
    if kind == "target":
        body, answered = _packed(arrays), 0
        while answered < TARGETS:
            u, v = rng.integers(0, np.array(image.depth_m.shape[::-1]))
            try:
                _ask((body, f"click={u},{v}"))
            except HTTPError:  # a floor, a wall, a table
                continue
            answered += 1
            yield body, f"click={u},{v}"
        return
    arrays["mask"] = image.mask
    if kind == "arrival":
        body = _packed(arrays)
        yield from ((body, f"arrival=normal:0.0{k}") for k in range(1, 7))
        return
    for _ in range(FRAMES):
        noise = rng.integers(-1, 2, image.depth_m.shape)
        depth = np.where(arrays["depth"] > 10, arrays["depth"] + noise, arrays["depth"]).astype(np.uint16)
        yield _packed(arrays | {"depth": depth}), ""


def _packed(arrays: dict[str, Any]) -> bytes:
    with BytesIO() as file:
        np.savez(file, **arrays)
        return file.getvalue()


def _ask(call: Call) -> dict[str, Any]:
    request = Request(f"http://127.0.0.1:{PORT}/base?{call[1]}", call[0])
    with urlopen(request, timeout=120) as answer:
        return json.load(answer)


def _wait() -> None:
    for _ in range(300):
        try:
            urlopen(f"http://127.0.0.1:{PORT}/health", timeout=5).close()
            return
        except URLError:
            time.sleep(0.2)
    raise SystemExit("datagen serve does not answer")


def _memory(processes: list[psutil.Process]) -> float:
    return sum(each.memory_full_info().uss for each in processes) / 2**20


def _cpu_s(processes: list[psutil.Process]) -> float:
    return sum(sum(each.cpu_times()[:2]) for each in processes)


if __name__ == "__main__":
    main()
