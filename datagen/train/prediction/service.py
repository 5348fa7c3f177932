"""Base poses over HTTP: a frame in, an answer out; frames of a session are fused."""

from __future__ import annotations

import asyncio
import hmac
import multiprocessing
import os
import re
import signal
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Query, Request

from datagen import __version__
from datagen.schemas.errors import InputError
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.frames import SensorFrame, read_place
from datagen.train.prediction.prediction_report import document

MOST_BYTES, MOST_SESSIONS, MOST_FRAMES = 64 << 20, 8, 6
_BODY = "body.npz"

Ask = Callable[[list[SensorFrame], dict[str, Any]], Prediction]  # of frames and options of a request
_asks: list[Ask] = []  # the one of this worker process


class Sessions(OrderedDict[str, list[bytes]]):
    """Frames of the latest sessions. The oldest frames and the longest unused sessions go first."""

    def add(self, name: str, frame: bytes) -> None:
        """Keep a new frame of a session."""
        self[name] = [*self.pop(name, []), frame][-MOST_FRAMES:]
        while len(self) > MOST_SESSIONS:
            self.popitem(last=False)


def _start(make_ask: Callable[[], Ask]) -> None:
    """Set up a worker process, which ends with the service. Ctrl-C reaches both, and only that handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    service = multiprocessing.parent_process()
    assert service is not None
    threading.Thread(target=lambda: (service.join(), os._exit(1)), daemon=True).start()
    _asks.append(make_ask())


@lru_cache(maxsize=MOST_FRAMES)
def _frame(body: bytes) -> SensorFrame:
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder) / _BODY).write_bytes(body)
        return read_place(file)


def _answer(bodies: list[bytes], options: dict[str, Any]) -> dict[str, Any]:
    return document(_asks[0]([_frame(body) for body in bodies], options))


def make_app(make_ask: Callable[[], Ask], model: str, token: str | None) -> FastAPI:
    """The application, with one worker process a core; with a token, requests must give it."""
    sessions, pools, count = Sessions(), list[ProcessPoolExecutor](), len(os.sched_getaffinity(0))

    def start_workers() -> None:
        context = multiprocessing.get_context("spawn")
        pools[:] = [ProcessPoolExecutor(count, context, _start, (make_ask,))]
        for _ in range(count):
            pools[0].submit(int)  # starts a process

    def allowed(request: Request) -> None:
        given = request.headers.get("authorization", "")
        if token is not None and not hmac.compare_digest(given.encode(), f"Bearer {token}".encode()):
            raise HTTPException(401, "give the token: Authorization: Bearer WORD")

    async def answer(bodies: list[bytes], options: dict[str, Any]) -> dict[str, Any]:
        pool = pools[0]
        try:
            return await asyncio.wrap_future(pool.submit(_answer, bodies, options))
        except InputError as error:
            raise HTTPException(422, re.sub(rf"\S*/{_BODY}", "the body", str(error))) from None
        except BrokenProcessPool:
            if pool is pools[0]:
                start_workers()
            raise HTTPException(503, "a worker process ended without a message: ask again") from None

    start_workers()
    app = FastAPI(title="datagen", version=__version__, dependencies=[Depends(allowed)])

    @app.get("/health")
    async def health() -> dict[str, Any]:  # pyright: ignore[reportUnusedFunction]
        """Which model answers, and how many sessions there are."""
        return {"model": model, "sessions": len(sessions)}

    @app.post("/base")
    async def base(  # pyright: ignore[reportUnusedFunction]
        request: Request,
        session: Annotated[str | None, Query(pattern=r"^[\w.-]{1,64}$")] = None,
        click: Annotated[str | None, Query(pattern=r"^[0-9]{1,6},[0-9]{1,6}$")] = None,
        arrival: Annotated[str | None, Query(max_length=60, pattern=r"^(nav2$|normal:|disc:)")] = None,
        allow_unseen: bool = False,
        camera_height: Annotated[float | None, Query(gt=0, le=10)] = None,
        candidates: bool = False,
    ) -> dict[str, Any]:
        """The base pose for the target in the frame of the body, an .npz, fused with those of its session."""
        data = bytearray()
        async for part in request.stream():
            data += part
            if len(data) > MOST_BYTES:
                raise HTTPException(413, f"the body has more than {MOST_BYTES >> 20} MiB")
        options = {
            "click": None if click is None else tuple(map(int, click.split(","))),
            "arrival": arrival,
            "allow_unseen": allow_unseen,
            "camera_height": camera_height,
            "candidates": candidates,
        }
        frames = [*sessions.get(session or "", ()), bytes(data)][-MOST_FRAMES:]
        found = await answer(frames, options)
        if session is not None:  # not before: a frame that cannot be read would spoil the session
            sessions.add(session, frames[-1])
        return found if candidates else {key: found[key] for key in found if key != "candidates"}

    @app.delete("/sessions/{name}")
    async def forget(name: str) -> dict[str, bool]:  # pyright: ignore[reportUnusedFunction]
        """Forget the frames of a session."""
        return {"was_there": sessions.pop(name, None) is not None}

    return app
