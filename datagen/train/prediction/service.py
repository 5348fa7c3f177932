"""Base poses over HTTP: a frame in, an answer out; frames of a session are fused."""

from __future__ import annotations

import hmac
import re
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import Depends, FastAPI, HTTPException, Query, Request

from datagen import __version__
from datagen.schemas.errors import InputError
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.files import read_arrays
from datagen.train.prediction.frames import SensorFrame, read_place
from datagen.train.prediction.goals import goal_document
from datagen.train.prediction.prediction_report import document
from datagen.worker_processes import WorkerProcesses
from datagen.workers.occupancy_map import OccupancyMap, grid_map

MOST_BYTES, MOST_SESSIONS, MOST_FRAMES = 64 << 20, 8, 6
_BODY = "body.npz"

Ask = Callable[[list[SensorFrame], dict[str, Any]], Prediction]  # of frames and options of a request


class Sessions(OrderedDict[str, list[bytes]]):
    """Frames of the latest sessions. The oldest frames and the longest unused sessions go first."""

    def add(self, name: str, frame: bytes) -> None:
        """Keep a new frame of a session."""
        self[name] = [*self.pop(name, []), frame][-MOST_FRAMES:]
        while len(self) > MOST_SESSIONS:
            self.popitem(last=False)


@lru_cache(maxsize=MOST_FRAMES)
def _read(body: bytes) -> tuple[SensorFrame, list[OccupancyMap]]:
    """The frame of a body, and the map that it has."""
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder) / _BODY).write_bytes(body)
        frame, arrays = read_place(file), read_arrays(file, ("intrinsics", "map", "map_pose"))
        if "map" not in arrays:
            return frame, []
        grid, at = arrays["map"], arrays.get("map_pose", np.zeros(0))
        sound = grid.dtype == np.int8 and grid.ndim == 2 and at.shape == (4,)
        if not (sound and (np.abs(at[:3]) < 1e5).all() and 0.001 <= at[3] <= 1):
            fix = "Give map (H, W) as int8, as in OccupancyGrid, and map_pose: x, y, yaw and resolution"
            raise InputError(file, "map", "is no map", fix)
        x, y, yaw, resolution_m = at.tolist()
        return frame, [grid_map("map", grid, resolution_m, (x, y, yaw))]


def answer_of(ask: Ask, bodies: list[bytes], options: dict[str, Any]) -> dict[str, Any]:
    """The document of an answer; `goal` has poses of the robot's base where the frames have poses."""
    frames, maps = zip(*map(_read, bodies), strict=True)
    found = ask(list(frames), options | {"map": maps[-1]})
    return document(found) | {"goal": goal_document(found, "map", 0)}


def make_app(workers: WorkerProcesses, model: str, token: str | None) -> FastAPI:
    """The application, for workers that call `answer_of`; with a token, requests must give it."""
    sessions = Sessions()

    def allowed(request: Request) -> None:
        given = request.headers.get("authorization", "")
        if token is not None and not hmac.compare_digest(given.encode(), f"Bearer {token}".encode()):
            raise HTTPException(401, "give the token: Authorization: Bearer WORD")

    rules = [Depends(allowed)]
    app = FastAPI(title="datagen", version=__version__, dependencies=rules, lifespan=lambda _: workers)

    @app.get("/health")
    async def health() -> dict[str, Any]:  # pyright: ignore[reportUnusedFunction]
        """Which model answers, and how many sessions there are."""
        return {"model": model, "sessions": len(sessions)}

    @app.post("/base")
    async def base(  # pyright: ignore[reportUnusedFunction]
        request: Request,
        session: Annotated[str | None, Query(pattern=r"^[\w.-]{1,64}$")] = None,
        click: Annotated[str | None, Query(pattern=r"^[0-9]{1,6},[0-9]{1,6}$")] = None,
        box: Annotated[str | None, Query(pattern=r"^[0-9]{1,6}(,[0-9]{1,6}){3}$")] = None,
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
            "box": None if box is None else tuple(map(int, box.split(","))),
            "arrival": arrival,
            "allow_unseen": allow_unseen,
            "camera_height": camera_height,
            "candidates": candidates,
        }
        frames = [*sessions.get(session or "", ()), bytes(data)][-MOST_FRAMES:]
        try:
            found = await workers.call(frames, options)
        except InputError as error:
            raise HTTPException(422, re.sub(rf"\S*/{_BODY}", "the body", str(error))) from None
        if session is not None:  # not before: a frame that cannot be read would spoil the session
            sessions.add(session, frames[-1])
        return found if candidates else {key: found[key] for key in found if key != "candidates"}

    @app.delete("/sessions/{name}")
    async def forget(name: str) -> dict[str, bool]:  # pyright: ignore[reportUnusedFunction]
        """Forget the frames of a session."""
        return {"was_there": sessions.pop(name, None) is not None}

    return app
