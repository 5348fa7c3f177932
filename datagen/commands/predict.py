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
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter, Token

from datagen.console.command_lines import prints
from datagen.console.options import AsJson, File, Whole, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.released import DEMO_BASE_HEIGHT_M, DEMO_CLICK, DEMO_REACH_M, RELEASED, sample_frame
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file
from datagen.workers.geometry.mesh import F64

if TYPE_CHECKING:
    from datagen.train.prediction import Footprint, Prediction
    from datagen.train.prediction.frames import SensorFrame
    from datagen.train.scorers import Scorer

    Frames = Sequence[str | Path | SensorFrame]
    Checkpoint = str | Path | Scorer
    Outline = str | float | Sequence[Sequence[float]] | Footprint
else:
    # Types that the command line resolves without importing torch.
    Prediction, Frames, Checkpoint, Outline = Any, Sequence[Path], str | Path, str

_LARGEST_M = 10.0
_MOST_FRAMES = 64
_MOST_ENTRIES = 10_000
# Written by --demo in the working folder, unless --out or --html is given.
DEMO_PICTURE, DEMO_PAGE = Path("demo.png"), Path("demo.html")


def print_prediction(
    prediction: Prediction,
    json: bool,
    out: str | Path | None = None,
    html: str | Path | None = None,
    demo: bool = False,
    **_: Any,
) -> int:
    """Print the best base pose; the exit code is 1 when no cell was seen to be clear."""
    from datagen.train.prediction.prediction_report import document, report_rows

    if json:
        print_json(document(prediction))
    else:
        if demo:
            out, html = out or DEMO_PICTURE, html or DEMO_PAGE
        written = [(name, str(file)) for name, file in (("picture", out), ("page", html)) if file is not None]
        print_rows(f"base poses by {prediction.scorer}", [*report_rows(prediction), *written])
    return 0 if prediction.best is not None else 1


def _pixel(kind: Any, tokens: Sequence[Token]) -> tuple[int, int]:
    text = tokens[0].value
    parts = text.split(",")
    if len(parts) != 2 or not all(re.fullmatch(r"\s*[0-9]{1,6}\s*", part, re.ASCII) for part in parts):
        raise InputError("--click", text[:40], "is not a pixel", "Give column and row as u,v: 320,240")
    return int(parts[0]), int(parts[1])


def _text(kind: Any, tokens: Sequence[Token]) -> str:
    return tokens[0].value


def _numbers(kind: Any, tokens: Sequence[Token]) -> list[float]:
    try:
        return [float(part) for part in tokens[0].value.split(",")]
    except ValueError:
        return []


@prints(print_prediction)
def predict(
    checkpoint: Annotated[Checkpoint | None, Parameter(name="CHECKPOINT")] = None,
    /,
    *,
    base_height: float | None = None,
    reach: float | None = None,
    demo: bool = False,
    rgb: File | None = None,
    depth: File | None = None,
    intrinsics: File | None = None,
    mask: File | None = None,
    click: Annotated[tuple[int, int] | None, Parameter(converter=_pixel, n_tokens=1, metavar="STR")] = None,
    frame: Frames | None = None,
    frame_dir: File | None = None,
    camera_height: float | None = None,
    camera_pose: File | None = None,
    gravity: Annotated[
        Sequence[float] | None, Parameter(converter=_numbers, n_tokens=1, metavar="STR")
    ] = None,
    robot_camera_height: float | None = None,
    footprint: Annotated[Outline | None, Parameter(converter=_text, n_tokens=1, metavar="STR")] = None,
    depth_scale: float = 0.001,
    grid: Whole = 25,
    half_width: float = 1.0,
    allow_unseen: bool = False,
    arrival: str | None = None,
    arrival_std: str | None = None,
    out: File | None = None,
    html: File | None = None,
    json: AsJson = False,
) -> Prediction:
    """Score a grid of base poses around a target seen by a depth camera, and name the best clear one.

    Give a frame as --rgb --depth --intrinsics with --mask or --click, or as --frame. The floor is known from
    --camera-pose, from --gravity and --camera-height, or from the image and --camera-height. Exit code 1 when
    no cell was seen to be clear.

    For example: datagen predict --base-height 0.4 --reach 0.85 --frame FRAME.npz --out best.png

    Args:
        checkpoint: Checkpoint of `datagen train`; in Python also a scorer of `datagen.load_scorer`
            [the released model].
        base_height: Height of the arm's mount above the floor (m); only --demo has a default.
        reach: Reach of the arm from its mount (m); only --demo has a default.
        demo: Predict on the frame that ships with the package; writes demo.png and demo.html.
        rgb: Colour image, aligned with the depth image.
        depth: Depth image, 16-bit PNG.
        intrinsics: JSON file: fx, fy, cx, cy (or ppx, ppy), width, height (pixels).
        mask: Mask of the target, PNG, white on black.
        click: Pixel u,v on the target in the first frame.
        frame: Frame as a folder, .npz or .ply; several with poses are fused.
        frame_dir: Folder of such frames, in order of name.
        camera_height: Height of the frame's camera (m).
        camera_pose: JSON file: T_world_camera (4x4); world z up, floor at z = 0.
        gravity: Direction of gravity x,y,z in the camera frame (x right, y down).
        robot_camera_height: Height of the robot's own camera (m) [that of the frame's camera].
        footprint: Base: radius (m), corners x,y;x,y;... around the mount, x ahead, or a robot [as trained].
        depth_scale: Metres per step of 16-bit depth.
        grid: Cells per side of the grid around the target.
        half_width: Half the side of the grid (m).
        allow_unseen: Also consider cells of which the floor, or the way there, was not seen.
        arrival: Arrival error to choose for: normal:M[,YAW], disc:M[,YAW], nav2 or FILE.csv.
        arrival_std: The same as --arrival normal:, in metres, with yaw after a comma: 0.05,3deg.
        out: Picture to write, FILE.png.
        html: Page to write, FILE.html.
        json: For the command line only.

    Returns:
        All poses. `best` is the row of the best clear one (None where none was seen to be clear),
        `T_world_base(row)` and `T_camera_base(row)` are 4x4 poses of the arm's mount (x towards the target),
        `base_xy_m` (N, 2) and `yaw_rad` (N,) those of all rows, `score` (N,) their scores, and `sure` the
        confidence in the answer. World is the frame of `T_world_camera` where frames have it, as a
        robot's map; else its origin is on the floor below the camera. A frame in Python may also be a
        SensorFrame.

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
    from datagen.train.arrivals import arrival_of
    from datagen.train.prediction import RobotSize, load_scorer, read_footprint
    from datagen.train.prediction import predict as scored

    if demo:
        _refuse_with_demo(rgb, depth, intrinsics, mask, click, frame, frame_dir, camera_pose)
        frame, click = [sample_frame()], DEMO_CLICK
        base_height, reach = base_height or DEMO_BASE_HEIGHT_M, reach or DEMO_REACH_M
        out, html = out or DEMO_PICTURE, html or DEMO_PAGE
    if base_height is None or reach is None:
        missing = "--base-height" if base_height is None else "--reach"
        raise InputError("datagen predict", missing, "is missing", "Give both lengths of the robot in metres")
    lengths = {"--base-height": base_height, "--reach": reach, "--camera-height": camera_height}
    for name, value in (lengths | {"--robot-camera-height": robot_camera_height}).items():
        _refuse_length(name, value)
    if not (math.isfinite(depth_scale) and 1e-6 <= depth_scale <= 1.0):
        fix = "Give metres per step: 0.001 for millimetres"
        raise InputError("--depth-scale", str(depth_scale), "is not between 0.000001 and 1", fix)
    outline = None if footprint is None else read_footprint(footprint)
    error = arrival_of(arrival, arrival_std)
    direction = None if gravity is None else _direction(gravity)
    rgb, depth, intrinsics, mask, camera_pose, frame_dir, out, html = (
        None if path is None else Path(path)
        for path in (rgb, depth, intrinsics, mask, camera_pose, frame_dir, out, html)
    )
    named = [Path(each) if isinstance(each, str) else each for each in frame or ()]
    frames = _frames(rgb, depth, intrinsics, mask, camera_pose, named, frame_dir, depth_scale)
    files = [each for each in named if isinstance(each, Path)]
    model = Path(checkpoint) if isinstance(checkpoint, (str, Path)) and checkpoint != RELEASED else None
    _refuse_outputs(out, html, [model, rgb, depth, intrinsics, mask, camera_pose, *files])
    own_height = robot_camera_height if robot_camera_height is not None else camera_height
    if own_height is None:
        own_height = float(frames[0].T_world_camera[2, 3]) if frames[0].T_world_camera is not None else None
    if own_height is None:
        fix = "Give it in metres above the floor, or --camera-pose pose.json"
        raise InputError("--camera-height", "", "missing", fix)
    _refuse_length("--robot-camera-height", own_height)
    answer = scored(
        load_scorer(checkpoint) if checkpoint is None or isinstance(checkpoint, (str, Path)) else checkpoint,
        frames,
        RobotSize(own_height, base_height, reach, outline),
        camera_height_m=camera_height,
        gravity=direction,
        click=click,
        allow_unseen=allow_unseen,
        arrival=error,
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
    frames_given: Sequence[Path | SensorFrame],
    folder: Path | None,
    depth_scale_m: float,
) -> list[SensorFrame]:
    """The frames that the options name; --camera-pose belongs to the first."""
    from datagen.train.prediction.files import read_pose
    from datagen.train.prediction.frames import read_frame, read_place

    named = list(frames_given)
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


def _refuse_with_demo(*given: object) -> None:
    """Raise InputError for an option of a frame with --demo, which has its own."""
    if any(each is not None for each in given):
        fix = "Omit --demo to predict on a frame of your own"
        raise InputError("--demo", "", "has a frame and a click of its own", fix)


def _refuse_length(name: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and 0 < value <= _LARGEST_M):
        raise InputError(name, f"{value:g}", f"is not between 0 and {_LARGEST_M:g}", "Give it in metres")


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
