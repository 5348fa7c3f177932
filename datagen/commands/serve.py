"""`datagen serve`: base poses over HTTP, for programs that have no Python or cannot import this package."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from datagen.commands.predict import predict, refuse_robot
from datagen.commands.predict_options import OUTLINE, UNSET, PredictOptions
from datagen.console.command_lines import options_of
from datagen.console.options import File
from datagen.display.progress import Progress
from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular

if TYPE_CHECKING:
    from fastapi import FastAPI

    from datagen.train.prediction import Prediction
    from datagen.train.prediction.frames import SensorFrame


@dataclass(frozen=True)
class ServeOptions:
    """Options of `serve`.

    Args:
        checkpoint: Checkpoint of `datagen train` [default: the released model]
        robot: Robot, or its file ROBOT.toml, as of `predict`.
        base_height: Height of the arm's mount above the floor (m).
        reach: Reach of the arm from its mount (m).
        footprint: Base, as of `predict`: radius (m), corners x,y;x,y;... around the mount, or a robot.
        map: Map of the floor, map.yaml; repeatable.
        keep_out: Map of which no base may stand on occupied cells.
        host: Address to listen on.
        port: Port to listen on.
        token: File with the word that requests must give as `Authorization: Bearer WORD`; needed beyond
            loopback addresses.
    """

    checkpoint: Annotated[str | None, Parameter(name="CHECKPOINT")] = None
    _: KW_ONLY
    robot: str | None = None
    base_height: float | None = None
    reach: float | None = None
    footprint: Annotated[str | None, OUTLINE] = None
    map: Annotated[Sequence[Path], UNSET] = ()
    keep_out: Annotated[Sequence[Path], UNSET] = ()
    host: str = "127.0.0.1"
    port: int = 8765
    token: File | None = None


@options_of(ServeOptions)
def serve(given: ServeOptions) -> None:
    """Answer requests for base poses: a frame in, an answer out; frames of a session are fused.

    POST /base takes an .npz with rgb, depth, intrinsics and optionally mask and T_world_camera as its body,
    and click or box, session, arrival, allow_unseen, camera_height, candidates as its query. /docs lists all.

    For example: datagen serve --robot fetch --map map.yaml
    """
    import uvicorn

    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # of the worker processes
    if not 1 <= given.port <= 65535:
        raise InputError("--port", str(given.port), "is not between 1 and 65535", "Choose another")
    app = app_of(given)
    with Progress() as shown, _listening(given.host, given.port) as bound:
        shown.phase(f"listening on http://{given.host}:{given.port}, described at /docs")
        # Not before: it takes over the process's logging.
        config = uvicorn.Config(app, log_level="warning", limit_concurrency=64)
        uvicorn.Server(config).run([bound])


def _listening(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise InputError("--port", str(port), f"cannot be listened on: {error}", "Choose another") from None


def app_of(given: ServeOptions) -> FastAPI:
    """The application. InputError for options that cannot be used."""
    from datagen.train.prediction import load_scorer
    from datagen.train.prediction.service import make_app
    from datagen.worker_processes import WorkerProcesses

    token = None if given.token is None else _token(Path(given.token))
    if token is None and not _is_loopback(given.host):
        fix = "Give --token FILE, or listen on 127.0.0.1"
        raise InputError("--host", given.host, "is no loopback address, and there is no --token", fix)
    answerer(given)  # refuses files that cannot be used
    workers = WorkerProcesses(partial(answerer, given))
    return make_app(workers, load_scorer(given.checkpoint).name, token)


def answerer(given: ServeOptions) -> Callable[..., dict[str, Any]]:
    """A function that answers requests, in one process."""
    from datagen.train.prediction import load_scorer, read_map
    from datagen.train.prediction.service import answer_of

    scorer, own_maps = load_scorer(given.checkpoint), [read_map(each) for each in given.map]
    names = "robot", "base_height", "reach", "footprint"
    fixed: dict[str, Any] = {name: getattr(given, name) for name in names}
    refuse_robot(PredictOptions(**fixed))
    fixed |= {"keep_out": [read_map(each) for each in given.keep_out]}

    def ask(frames: list[SensorFrame], options: dict[str, Any]) -> Prediction:
        maps = [*options.pop("map"), *own_maps]
        return predict(scorer, frame=frames, map=maps, **fixed, **options)

    return partial(answer_of, ask)


def _token(path: Path) -> str:
    word = read_regular(path, 4096, "Name a file with one word").decode("utf-8", "replace").strip()
    if not re.fullmatch(r"[!-~]{16,}", word):
        raise InputError(path, "--token", "is not one word of 16 or more characters", "Write a random word")
    return word


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
