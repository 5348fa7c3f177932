"""`datagen predict`: find a base pose in a depth camera's frame, with a trained checkpoint."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter

from datagen.console.options import AsJson, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file
from datagen.workers.geometry.mesh import F64

if TYPE_CHECKING:
    from datagen.train.prediction.frames import SensorFrame

_LARGEST_M = 10.0
_MOST_FRAMES = 64
_MOST_ENTRIES = 10_000


def predict(
    checkpoint: Annotated[Path, Parameter(name="CHECKPOINT", help="Checkpoint of `datagen train`.")],
    /,
    *,
    base_height: Annotated[float, Parameter(help="Height of the arm's mount above the floor (m).")],
    reach: Annotated[float, Parameter(help="Reach of the arm from its mount (m).")],
    rgb: Annotated[Path | None, Parameter(help="Colour image, aligned with the depth image.")] = None,
    depth: Annotated[Path | None, Parameter(help="Depth image, 16-bit PNG.")] = None,
    intrinsics: Annotated[
        Path | None, Parameter(help="JSON file: fx, fy, cx, cy (or ppx, ppy), width, height (pixels).")
    ] = None,
    mask: Annotated[Path | None, Parameter(help="Mask of the target, PNG, white on black.")] = None,
    click: Annotated[str | None, Parameter(help="Pixel u,v on the target in the first frame.")] = None,
    frame: Annotated[
        list[Path] | None,
        Parameter(help="Frame as a folder, .npz or .ply; several with poses are fused.", negative=()),
    ] = None,
    frame_dir: Annotated[Path | None, Parameter(help="Folder of such frames, in order of name.")] = None,
    camera_height: Annotated[float | None, Parameter(help="Height of the frame's camera (m).")] = None,
    camera_pose: Annotated[
        Path | None, Parameter(help="JSON file: T_world_camera (4x4); world z up, floor at z = 0.")
    ] = None,
    gravity: Annotated[
        str | None, Parameter(help="Direction of gravity x,y,z in the camera frame (x right, y down).")
    ] = None,
    robot_camera_height: Annotated[
        float | None, Parameter(help="Height of the robot's own camera (m) [that of the frame's camera].")
    ] = None,
    depth_scale: Annotated[float, Parameter(help="Metres per step of 16-bit depth.")] = 0.001,
    grid: Annotated[int, WHOLE_NUMBER, Parameter(help="Cells per side of the grid around the target.")] = 25,
    half_width: Annotated[float, Parameter(help="Half the side of the grid (m).")] = 1.0,
    allow_unseen: Annotated[
        bool, Parameter(negative=(), help="Also consider cells whose floor no camera saw.")
    ] = False,
    out: Annotated[Path | None, Parameter(help="Picture to write, FILE.png.")] = None,
    html: Annotated[Path | None, Parameter(help="Page to write, FILE.html.")] = None,
    as_json: Annotated[AsJson, Parameter(name="--json")] = False,
) -> int:
    """Score a grid of base poses around a target seen by a depth camera, and name the best clear one.

    Give a frame as --rgb --depth --intrinsics with --mask or --click, or as --frame. The floor is known from
    --camera-pose, from --gravity and --camera-height, or from the image and --camera-height. Exit code 1 when
    no cell was seen to be clear.

    For example: datagen predict model.ckpt --base-height 0.4 --reach 0.85 --frame FRAME.npz --out best.png
    """
    # Imported here: the libraries of training take seconds to import.
    from datagen.train.prediction import RobotSize, load_scorer
    from datagen.train.prediction import predict as scored
    from datagen.train.prediction.prediction_report import document, told

    lengths = {"--base-height": base_height, "--reach": reach, "--camera-height": camera_height}
    for name, value in (lengths | {"--robot-camera-height": robot_camera_height}).items():
        _refuse_length(name, value)
    if not (math.isfinite(depth_scale) and 1e-6 <= depth_scale <= 1.0):
        mend = "Give metres per step: 0.001 for millimetres"
        raise InputError("--depth-scale", str(depth_scale), "is not between 0.000001 and 1", mend)
    pixel = None if click is None else _pixel(click)
    falls = None if gravity is None else _direction(gravity)
    frames = _frames(rgb, depth, intrinsics, mask, camera_pose, frame, frame_dir, depth_scale)
    _refuse_outputs(out, html, [checkpoint, rgb, depth, intrinsics, mask, camera_pose, *(frame or [])])
    own_height = robot_camera_height if robot_camera_height is not None else camera_height
    if own_height is None:
        own_height = float(frames[0].T_world_camera[2, 3]) if frames[0].T_world_camera is not None else None
    if own_height is None:
        mend = "Give it in metres above the floor, or --camera-pose pose.json"
        raise InputError("--camera-height", "", "missing", mend)
    _refuse_length("--robot-camera-height", own_height)
    answer = scored(
        load_scorer(checkpoint),
        frames,
        RobotSize(own_height, base_height, reach),
        camera_height_m=camera_height,
        gravity=falls,
        click=pixel,
        allow_unseen=allow_unseen,
        grid=grid,
        half_width_m=half_width,
    )
    if out is not None:
        from datagen.train.prediction.pictures import draw_prediction

        with whole_file(out, alone=True) as file:
            draw_prediction(answer, file)
    if html is not None:
        from datagen.train.prediction.page import page_of

        with whole_file(html, alone=True) as file:
            file.write(page_of(answer).encode())
    if as_json:
        print_json(document(answer))
    else:
        written = [(name, str(file)) for name, file in (("picture", out), ("page", html)) if file is not None]
        print_rows(f"base poses by {answer.scorer}", [*told(answer), *written])
    return 0 if answer.best is not None else 1


def _frames(
    rgb: Path | None,
    depth: Path | None,
    intrinsics: Path | None,
    mask: Path | None,
    camera_pose: Path | None,
    places: Sequence[Path] | None,
    folder: Path | None,
    depth_scale_m: float,
) -> list[SensorFrame]:
    """The frames that the options name; --camera-pose belongs to the first."""
    from datagen.train.prediction.files import read_pose
    from datagen.train.prediction.frames import read_frame, read_place

    named = list(places or [])
    if folder is not None:
        if not folder.is_dir():
            raise InputError(folder, "--frame-dir", "does not exist", "Name a folder of frames")
        with os.scandir(folder) as entries:
            listed = [Path(entry) for entry in islice(entries, _MOST_ENTRIES + 1)]
        if len(listed) > _MOST_ENTRIES:
            problem = f"holds more than {_MOST_ENTRIES:,} files"
            raise InputError(folder, "--frame-dir", problem, "Name a folder of frames")
        named += sorted(p for p in listed if p.is_dir() or p.suffix.lower() in (".npz", ".ply"))
    parts = {"--rgb": rgb, "--depth": depth, "--intrinsics": intrinsics}
    missing = [name for name, value in parts.items() if value is None]
    pictures = rgb is not None or depth is not None or intrinsics is not None or mask is not None
    if len(named) > _MOST_FRAMES:
        raise InputError("--frame", "", f"is given {len(named)} times", f"Give at most {_MOST_FRAMES} frames")
    if pictures and missing:
        raise InputError(", ".join(missing), "", "is missing", "Give --rgb, --depth and --intrinsics")
    frames: list[SensorFrame] = []
    if rgb is not None and depth is not None and intrinsics is not None:
        frames.append(
            read_frame(rgb, depth, intrinsics, mask=mask, pose=camera_pose, depth_scale_m=depth_scale_m)
        )
    elif camera_pose is not None and len(named) != 1:
        mend = "Put pose.json into each frame's folder, or T_world_camera into its .npz"
        raise InputError("--camera-pose", "", f"is one pose for {len(named)} frames", mend)
    frames += [read_place(place, depth_scale_m) for place in named]
    if not frames:
        raise InputError(
            "--rgb, --depth", "", "no frame is given", "Give --rgb, --depth and --intrinsics, or --frame"
        )
    if not pictures and camera_pose is not None:
        frames[0] = replace(frames[0], T_world_camera=read_pose(camera_pose))
    return frames


def _refuse_length(name: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and 0 < value <= _LARGEST_M):
        raise InputError(name, f"{value:g}", f"is not between 0 and {_LARGEST_M:g}", "Give it in metres")


def _pixel(text: str) -> tuple[int, int]:
    parts = text.split(",")
    if len(parts) != 2 or not all(re.fullmatch(r"\s*[0-9]{1,6}\s*", part, re.ASCII) for part in parts):
        raise InputError("--click", text[:40], "is not a pixel", "Give column and row as u,v: 320,240")
    return int(parts[0]), int(parts[1])


def _direction(text: str) -> F64:
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    sound = values.shape == (3,) and bool(np.isfinite(values).all())
    if not sound or not 1e-6 < float(np.abs(values).max()) < 1e6:
        mend = "Give x,y,z in the camera frame: 0,1,0 for a level camera"
        raise InputError("--gravity", text[:60], "is not a direction", mend)
    return values


def _refuse_outputs(out: Path | None, html: Path | None, inputs: Sequence[Path | None]) -> None:
    """Raise InputError for an output that is a folder or one of the inputs."""
    if html is not None:
        import_module("datagen.train.prediction.page")  # reports a missing library before scoring
    read = {path.resolve() for path in inputs if path is not None}
    for option, file, suffix in (("--out", out, ".png"), ("--html", html, ".html")):
        if file is None:
            continue
        refuse_output(file, option, suffix)
        if file.is_dir() or file.resolve() in read:
            problem = "is a folder" if file.is_dir() else "is one of the input files"
            raise InputError(file, option, problem, "Give another name")
