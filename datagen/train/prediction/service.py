"""Base poses over HTTP: a frame in, an answer out; frames of a session are fused."""

from __future__ import annotations

import hmac
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Query, Request
from starlette.concurrency import run_in_threadpool

from datagen import __version__
from datagen.schemas.errors import InputError
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.frames import SensorFrame, read_place
from datagen.train.prediction.prediction_report import document

MOST_BYTES, MOST_SESSIONS, MOST_FRAMES = 64 << 20, 8, 6

Ask = Callable[[list[SensorFrame], dict[str, Any]], Prediction]  # of frames and options of a request


class Sessions:
    """Frames of the latest sessions. The oldest frames and the longest unused sessions go first."""

    def __init__(self) -> None:
        self._frames = OrderedDict[str, list[SensorFrame]]()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._frames)

    def joined(self, name: str, frame: SensorFrame) -> list[SensorFrame]:
        """The session's frames with a new one."""
        with self._lock:
            frames = [*self._frames.pop(name, []), frame][-MOST_FRAMES:]
            self._frames[name] = frames
            while len(self._frames) > MOST_SESSIONS:
                self._frames.popitem(last=False)
            return frames

    def forget(self, name: str) -> bool:
        """Remove a session; whether it was there."""
        with self._lock:
            return self._frames.pop(name, None) is not None


def make_app(ask: Ask, model: str, token: str | None) -> FastAPI:
    """The application. Answers are computed one at a time; with a token, requests must give it."""
    sessions, one_at_a_time = Sessions(), threading.Lock()

    def allowed(request: Request) -> None:
        given = request.headers.get("authorization", "")
        if token is not None and not hmac.compare_digest(given.encode(), f"Bearer {token}".encode()):
            raise HTTPException(401, "give the token: Authorization: Bearer WORD")

    def answer(data: bytes, session: str | None, options: dict[str, Any]) -> dict[str, Any]:
        with tempfile.NamedTemporaryFile(suffix=".npz") as file:
            file.write(data)
            file.flush()
            try:
                frame = read_place(file.name)
                frames = [frame] if session is None else sessions.joined(session, frame)
                with one_at_a_time:
                    return document(ask(frames, options))
            except InputError as error:
                raise HTTPException(422, str(error).replace(file.name, "the body")) from None

    app = FastAPI(title="datagen", version=__version__, dependencies=[Depends(allowed)])

    @app.get("/health")
    def health() -> dict[str, Any]:  # pyright: ignore[reportUnusedFunction]
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
        }
        found = await run_in_threadpool(answer, bytes(data), session, options)
        return found if candidates else {key: found[key] for key in found if key != "candidates"}

    @app.delete("/sessions/{name}")
    def forget(name: str) -> dict[str, bool]:  # pyright: ignore[reportUnusedFunction]
        """Forget the frames of a session."""
        return {"was_there": sessions.forget(name)}

    return app
