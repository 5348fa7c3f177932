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
    from datagen.train.prediction import Prediction
    from datagen.train.prediction.frames import SensorFrame

_LARGEST_M = 10.0
_MOST_FRAMES = 64
_MOST_ENTRIES = 10_000


def verb(
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
    from datagen.train.prediction.prediction_report import document, told

    answer = predict(
        checkpoint,
        base_height=base_height,
        reach=reach,
        rgb=rgb,
        depth=depth,
        intrinsics=intrinsics,
        mask=mask,
        click=None if click is None else _pixel(click),
        frame=frame,
        frame_dir=frame_dir,
        camera_height=camera_height,
        camera_pose=camera_pose,
        gravity=None if gravity is None else _numbers(gravity),
        robot_camera_height=robot_camera_height,
        depth_scale=depth_scale,
        grid=grid,
        half_width=half_width,
        allow_unseen=allow_unseen,
        out=out,
        html=html,
    )
    if as_json:
        print_json(document(answer))
    else:
        written = [(name, str(file)) for name, file in (("picture", out), ("page", html)) if file is not None]
        print_rows(f"base poses by {answer.scorer}", [*told(answer), *written])
    return 0 if answer.best is not None else 1


def predict(
    checkpoint: str | Path,
    *,
    base_height: float,
    reach: float,
    rgb: str | Path | None = None,
    depth: str | Path | None = None,
    intrinsics: str | Path | None = None,
    mask: str | Path | None = None,
    click: tuple[int, int] | None = None,
    frame: Sequence[str | Path | SensorFrame] | None = None,
    frame_dir: str | Path | None = None,
    camera_height: float | None = None,
    camera_pose: str | Path | None = None,
    gravity: Sequence[float] | None = None,
    robot_camera_height: float | None = None,
    depth_scale: float = 0.001,
    grid: int = 25,
    half_width: float = 1.0,
    allow_unseen: bool = False,
    out: str | Path | None = None,
    html: str | Path | None = None,
) -> Prediction:
    """Score a grid of base poses around a target that a depth camera sees; return all of them.

    Of the result, `best` is the row of the best clear pose (None where none was seen to be clear),
    `T_world_base(row)` and `T_camera_base(row)` are 4x4 poses of the arm's mount (x towards the target),
    `base_xy_m` (N, 2) and `yaw_rad` (N,) those of all rows, `score` (N,) says how good they are, and
    `sure` how far to trust the answer. World is the frame of `T_world_camera` where frames have it, as a
    robot's map; else its origin is on the floor below the camera.

    Args:
        checkpoint: A file that `train_model` wrote.
        base_height: Height of the arm's mount above the floor, m.
        reach: Reach of the arm, m.
        rgb: Colour picture, aligned with the depth.
        depth: 16-bit depth PNG.
        intrinsics: JSON with fx, fy, cx, cy, width, height.
        mask: PNG of the target's pixels, white on black.
        click: A pixel (u, v) on the target of the first frame.
        frame: Folders, .npz or .ply files, or SensorFrame objects; several with poses are fused.
        frame_dir: A folder of such frames, taken by name.
        camera_height: Height of the camera that took the frame, m.
        camera_pose: JSON with T_world_camera (4x4); world z up, floor at z = 0.
        gravity: Where things fall (x, y, z), in the camera's frame (x right, y down).
        robot_camera_height: Height of the robot's own camera, m [that of the frame's].
        depth_scale: Metres per step of 16-bit depth.
        grid: Cells on a side of the grid around the target.
        half_width: Half the grid's side, m.
        allow_unseen: Choose also among poses whose floor was not seen.
        out: PNG picture to write.
        html: HTML page to write.

    Raises:
        InputError: A frame, the checkpoint or an option cannot be used.

    Example:
        >>> robot = datagen.robots["fetch"]
        >>> answer = datagen.predict(
        ...     checkpoint, frame=[frame], base_height=robot.base_height_m[0], reach=robot.reach_m[1]
        ... )
        >>> answer.base_xy_m.shape, answer.T_world_base(0).shape
        ((625, 2), (4, 4))
    """
    # Imported here: the libraries of training take seconds to import.
    from datagen.train.prediction import RobotSize, load_scorer
    from datagen.train.prediction import predict as scored

    lengths = {"--base-height": base_height, "--reach": reach, "--camera-height": camera_height}
    for name, value in (lengths | {"--robot-camera-height": robot_camera_height}).items():
        _refuse_length(name, value)
    if not (math.isfinite(depth_scale) and 1e-6 <= depth_scale <= 1.0):
        fix = "Give metres per step: 0.001 for millimetres"
        raise InputError("--depth-scale", str(depth_scale), "is not between 0.000001 and 1", fix)
    falls = None if gravity is None else _direction(gravity)
    rgb, depth, intrinsics, mask, camera_pose, frame_dir, out, html = (
        None if path is None else Path(path)
        for path in (rgb, depth, intrinsics, mask, camera_pose, frame_dir, out, html)
    )
    named = [Path(each) if isinstance(each, str) else each for each in frame or ()]
    frames = _frames(rgb, depth, intrinsics, mask, camera_pose, named, frame_dir, depth_scale)
    files = [each for each in named if isinstance(each, Path)]
    _refuse_outputs(out, html, [Path(checkpoint), rgb, depth, intrinsics, mask, camera_pose, *files])
    own_height = robot_camera_height if robot_camera_height is not None else camera_height
    if own_height is None:
        own_height = float(frames[0].T_world_camera[2, 3]) if frames[0].T_world_camera is not None else None
    if own_height is None:
        fix = "Give it in metres above the floor, or --camera-pose pose.json"
        raise InputError("--camera-height", "", "missing", fix)
    _refuse_length("--robot-camera-height", own_height)
    answer = scored(
        load_scorer(checkpoint),
        frames,
        RobotSize(own_height, base_height, reach),
        camera_height_m=camera_height,
        gravity=falls,
        click=click,
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
    return answer


def _frames(
    rgb: Path | None,
    depth: Path | None,
    intrinsics: Path | None,
    mask: Path | None,
    camera_pose: Path | None,
    places: Sequence[Path | SensorFrame],
    folder: Path | None,
    depth_scale_m: float,
) -> list[SensorFrame]:
    """The frames that the options name; --camera-pose belongs to the first."""
    from datagen.train.prediction.files import read_pose
    from datagen.train.prediction.frames import read_frame, read_place

    named = list(places)
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
        fix = "Put pose.json into each frame's folder, or T_world_camera into its .npz"
        raise InputError("--camera-pose", "", f"is one pose for {len(named)} frames", fix)
    frames += [read_place(each, depth_scale_m) if isinstance(each, Path) else each for each in named]
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


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def _direction(given: Sequence[float]) -> F64:
    values = np.array(given, np.float64)
    sound = values.shape == (3,) and bool(np.isfinite(values).all())
    if not sound or not 1e-6 < float(np.abs(values).max()) < 1e6:
        fix = "Give x,y,z in the camera frame: 0,1,0 for a level camera"
        raise InputError("--gravity", ",".join(f"{value:g}" for value in given), "is not a direction", fix)
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
