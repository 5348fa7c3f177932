"""Base poses over HTTP: a frame in, an answer out; frames of a session are fused."""

from __future__ import annotations

import hmac
import re
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from fastapi import Depends, FastAPI, HTTPException, Query, Request
from pydantic import BaseModel, Field

from datagen import __version__
from datagen.schemas.errors import InputError
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.files import read_arrays
from datagen.train.prediction.frames import SensorFrame, read_place
from datagen.train.prediction.goals import goal_document
from datagen.train.prediction.predict import marked
from datagen.train.prediction.prediction_report import document
from datagen.worker_processes import WorkerProcesses
from datagen.workers.occupancy_map import OccupancyMap, grid_map

MOST_BYTES, MOST_SESSIONS, MOST_FRAMES = 64 << 20, 8, 6
_BODY = "body.npz"

Ask = Callable[[list[SensorFrame], dict[str, Any]], Prediction]  # of frames and options of a request


class Sent(NamedTuple):
    """A frame as it was sent, and where its target was marked besides a mask."""

    body: bytes
    click: list[int] | None
    box: list[int] | None

    @property
    def marks(self) -> dict[str, Any]:
        """Its click and box, as `predict` takes them."""
        both = {"click": self.click, "box": self.box}
        return {name: None if given is None else tuple(given) for name, given in both.items()}


class Asked(BaseModel, extra="forbid"):
    """Options of a request; a misspelt one is refused."""

    session: str | None = Field(None, pattern=r"^[\w.-]{1,64}$")
    click: str | None = Field(None, pattern=r"^[0-9]{1,6},[0-9]{1,6}$")
    box: str | None = Field(None, pattern=r"^[0-9]{1,6}(,[0-9]{1,6}){3}$")
    arrival: str | None = Field(None, max_length=60, pattern=r"^(nav2$|normal:|disc:)")
    allow_unseen: bool = False
    camera_height: float | None = Field(None, gt=0, le=10)
    candidates: bool = False


class Sessions(OrderedDict[str, list[Sent]]):
    """Frames of the latest sessions, the latest first. The oldest and the longest unused sessions go."""

    def add(self, name: str, frame: Sent) -> None:
        self[name] = [frame, *self.pop(name, [])][:MOST_FRAMES]
        while len(self) > MOST_SESSIONS:
            self.popitem(last=False)


@lru_cache(maxsize=MOST_FRAMES)
def _read(body: bytes) -> tuple[SensorFrame, list[OccupancyMap]]:
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


def answer_of(ask: Ask, sent: list[Sent], options: dict[str, Any]) -> dict[str, Any]:
    """The document of an answer; `goal` has poses of the robot's base where the frames have poses.

    Of the frames, the latest first, the first that marks a target does; the latest map counts.
    """
    frames, maps = map(list, zip(*(_read(each.body) for each in sent), strict=True))
    marks = (k for k, each in enumerate(sent) if frames[k].on_target is not None or each.click or each.box)
    last = next(marks, 0)
    for k, each in enumerate(sent):
        if k != last:
            frames[k] = _unmarked(frames[k])
        elif k and (T := frames[k].T_world_camera) is not None:
            frames[k] = marked(frames[k], T, **each.marks)
    options = options | {"map": next(filter(None, maps), [])}
    if last == 0:
        options |= sent[0].marks
    found = ask(frames, options)
    return document(found) | {"goal": goal_document(found, "map", 0)}


def _unmarked(frame: SensorFrame) -> SensorFrame:
    image = None if frame.image is None else replace(frame.image, mask=None)
    return replace(frame, on_target=None, image=image)


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
        request: Request, asked: Annotated[Asked, Query()]
    ) -> dict[str, Any]:
        """The base pose for the target in the frame of the body, an .npz, fused with those of its session.

        Where the frame has no mask, click or box, the target is that of the session's last frame that has.
        """
        data = bytearray()
        async for part in request.stream():
            data += part
            if len(data) > MOST_BYTES:
                raise HTTPException(413, f"the body has more than {MOST_BYTES >> 20} MiB")
        session, options = asked.session, asked.model_dump(exclude={"session", "click", "box", "candidates"})
        at, sides = (
            None if text is None else [*map(int, text.split(","))] for text in (asked.click, asked.box)
        )
        frames = [Sent(bytes(data), at, sides), *sessions.get(session or "", ())][:MOST_FRAMES]
        try:
            found = await workers.call(frames, options)
        except InputError as error:
            raise HTTPException(422, re.sub(rf"\S*/{_BODY}", "the body", str(error))) from None
        if session is not None:  # not before: a frame that cannot be read would spoil the session
            sessions.add(session, frames[0])
        return found if asked.candidates else {key: found[key] for key in found if key != "candidates"}

    @app.delete("/sessions/{name}")
    async def forget(name: str) -> dict[str, bool]:  # pyright: ignore[reportUnusedFunction]
        """Forget the frames of a session."""
        return {"was_there": sessions.pop(name, None) is not None}

    return app
