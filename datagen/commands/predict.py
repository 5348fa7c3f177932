"""`datagen predict`: find a base pose in a depth camera's frame, with a trained checkpoint."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from datagen.commands.predict_options import PredictOptions
from datagen.console.command_lines import options_of, prints
from datagen.console.options import refuse_output
from datagen.console.printing import compiling_shown, print_json, print_lines, print_rows
from datagen.released import DEMO_BASE_HEIGHT_M, DEMO_REACH_M, MAP, sample_frame
from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import whole_file
from datagen.workers.geometry.mesh import F64
from datagen.workers.robots import robot_limits

if TYPE_CHECKING:
    from datagen.train.prediction import Footprint, Prediction
else:
    Prediction = Any  # a type that the command line resolves without importing its module

T = TypeVar("T")
# Written by --demo in the working folder, unless --out or --html is given.
DEMO_PICTURE, DEMO_PAGE = Path("demo.png"), Path("demo.html")
# Options of --demo that decide its answer, for the command that repeats it.
_KEPT = ("robot", "robot_camera_height", "footprint", "allow_unseen", "keep_out", "arrival")


def print_prediction(
    prediction: Prediction,
    json: bool,
    out: str | Path | None = None,
    html: str | Path | None = None,
    demo: bool = False,
    export: str | Path | None = None,
    goal: str | Path | None = None,
    **rest: Any,
) -> int:
    """Print the best base pose; the exit code is 1 where no clear one has a good score."""
    from datagen.train.prediction.prediction_report import document, report_rows

    if json:
        print_json(document(prediction))
    else:
        if demo:
            out, html = out or DEMO_PICTURE, html or _demo_page()
        files = ("picture", out), ("page", html), ("goal", goal)
        written = [(name, str(file)) for name, file in files if file is not None]
        if goal is not None and prediction.best is None:
            written[-1] = ("goal", f"none: {goal} is not written")
        print_rows(f"base poses by {prediction.scorer}", [*report_rows(prediction), *written])
        if demo:
            place, own = sample_frame() if export is None else Path(export), prediction.robot
            sizes = {"base_height": f"{own.base_height_m:g}", "reach": f"{own.arm_reach_m:g}"}
            options = {"frame": place, "map": rest["map"] or [place / MAP], **sizes, "out": "answer.png"}
            words = ["datagen", "predict", *([] if rest["checkpoint"] is None else [str(rest["checkpoint"])])]
            words += _words(options | {name: rest[name] for name in _KEPT})
            print_lines(f"again: {shlex.join(words)}")  # a table would break the line
    return 0 if prediction.best is not None else 1


def _words(options: dict[str, Any]) -> list[str]:
    """Options as words of a command line."""
    words = list[str]()
    for name, value in options.items():
        for each in value if isinstance(value, Sequence) and not isinstance(value, str) else [value]:
            if each is not None and each is not False:
                words += [f"--{name.replace('_', '-')}", *([] if each is True else [str(each)])]
    return words


def _demo_page() -> Path | None:
    """None where the library of pages is not installed."""
    return DEMO_PAGE if find_spec("plotly") else None


@prints(print_prediction)
@options_of(PredictOptions)
def predict(given: PredictOptions) -> Prediction:
    """Score a grid of base poses around a target seen by a depth camera, and name the best clear one.

    A folder of a frame holds color.png, depth.png (16 bits), intrinsics.json (fx, fy, cx, cy; or as ROS,
    RealSense or Open3D have it), and optionally mask.png of the target and pose.json (T_world_camera, 4x4,
    floor at z = 0); other usual names and formats are found too. The floor is
    known from the pose, from --gravity and --camera-height, or from the image and --camera-height. Exit code
    1 where no clear base pose has a good score.

    For example: datagen predict --base-height 0.7 --reach 0.85 --frame FRAME --out best.png

    Returns:
        All poses. `level` is "good", "doubtful" or "none", for `reasons`. `best` is the row of the best clear
        pose (None where none has a good score), `T_world_base(row)` and `T_camera_base(row)` are 4x4 poses of
        the arm's mount (x to the base's front), `base_xy_m` (N, 2) and `yaw_rad` (N,) those of all rows, and
        `score` (N,) their scores, 0 where the base cannot stand or the arm is over 6 cm too short. World is
        the frame of `T_world_camera` where frames have it, as a robot's map; else its origin is on the floor
        below the camera. A frame in Python may also be a SensorFrame.

    Raises:
        InputError: A frame, the checkpoint or an option cannot be used.

    Examples:
        >>> robot = datagen.robots["fetch"]
        >>> answer = datagen.predict(
        ...     checkpoint, frame=[frame], base_height=robot.base_height_m[0], reach=robot.reach_m[1]
        ... )
        >>> answer.base_xy_m.shape, answer.T_world_base(0).shape
        ((676, 2), (4, 4))
    """
    # Imported here: the libraries of training take seconds to import.
    from datagen.train.arrivals import read_arrival
    from datagen.train.prediction import (
        KnownFloor,
        RobotSize,
        load_scorer,
        read_map,
        read_place,
    )
    from datagen.train.prediction import predict as scored

    name, copied = given.robot or "", given.export
    given, yaw_rad = (given, 0.0) if given.robot is None else _of_robot(given, given.robot)
    if given.demo:
        given = replace(
            given,
            demo=False,
            export=None,
            frame=[sample_frame()],
            map=given.map or [sample_frame() / MAP],
            base_height=DEMO_BASE_HEIGHT_M if given.base_height is None else given.base_height,
            reach=DEMO_REACH_M if given.reach is None else given.reach,
            out=DEMO_PICTURE if given.out is None else given.out,
            html=_demo_page() if given.html is None else given.html,
        )
    size, outline = _sizes(given)
    error = None if given.arrival is None else read_arrival(given.arrival)
    direction = None if given.gravity is None else _direction(given.gravity)
    out, html, goal = (None if file is None else Path(file) for file in (given.out, given.html, given.goal))
    maps, keep_out = (
        tuple(read_map(Path(each)) if isinstance(each, (str, Path)) else each for each in given_maps)
        for given_maps in (given.map, given.keep_out)
    )
    named, recorded = given.frame or (), None
    pictures = [each.picture for each in (*maps, *keep_out)]
    _refuse_outputs(out, html, goal, [*named, given.bag, *given.map, *given.keep_out, *pictures, copied])
    if given.bag is not None:
        from datagen.train.prediction.frames import write_place
        from datagen.train.prediction.recordings import read_recording

        recorded = read_recording(Path(given.bag), given.at, given.topic)
        if (given.map or given.keep_out) and recorded.world.rpartition("/")[2].startswith(("odom", "base")):
            problem = f"is no map of the frame {recorded.world}, in which the recording has its poses"
            fix = "Record with localisation, which sends the transform from map to odom, or omit the map"
            raise InputError("--map" if given.map else "--keep-out", "", problem, fix)
        named = recorded.frames
        if copied is not None:
            write_place(recorded.frames[0], Path(copied))
        maps = maps or tuple(each for each in [recorded.map] if each is not None)
    frames = [
        read_place(each, given.depth_scale) if isinstance(each, (str, Path)) else each
        for each in _required(named or None, "--frame")
    ]
    own_height = given.camera_height if given.robot_camera_height is None else given.robot_camera_height
    if own_height is None and frames and (pose := frames[0].T_world_camera) is not None:
        own_height = float(pose[2, 3])
    scorer = given.checkpoint
    answer = scored(
        load_scorer(scorer) if scorer is None or isinstance(scorer, (str, Path)) else scorer,
        frames,
        RobotSize(_required(own_height, "--camera-height"), *size, outline, yaw_rad, name),
        camera_height_m=given.camera_height,
        gravity=direction,
        click=given.click,
        box=given.box,
        allow_unseen=given.allow_unseen,
        arrival=error,
        known=KnownFloor(maps, keep_out) if maps or keep_out else None,
    )
    if out is not None:
        from datagen.train.prediction.pictures import draw_prediction

        with whole_file(out, alone=True) as file:
            draw_prediction(answer, file, out.suffix.lower())
    if html is not None:
        from datagen.train.prediction.page import page_of

        with whole_file(html, alone=True) as file:
            file.write(page_of(answer).encode())
    if goal is not None:
        from datagen.train.prediction.goals import write_goal

        write_goal(goal, answer, *(("map", 0) if recorded is None else (recorded.world, recorded.stamp_ns)))
    if copied is not None and recorded is None:
        shutil.copytree(sample_frame(), copied, copy_function=shutil.copyfile)  # writable
    return answer


def _of_robot(given: PredictOptions, robot: str) -> tuple[PredictOptions, float]:
    """The options with a robot's sizes where they give none, and its heading to the target (rad)."""
    with compiling_shown(given.json):
        limits = robot_limits(robot)
    (low, high), heights = limits.reach_m, limits.base_height_m
    sizes = {
        "reach": high if low == high else None,
        "base_height": heights[0] if heights is not None and heights[0] == heights[1] else None,
        "footprint": None if limits.base_radius_m is None else robot,
    }
    missing = {name: value for name, value in sizes.items() if getattr(given, name) is None}
    return replace(given, robot=None, **missing), limits.yaw_rad


def _sizes(given: PredictOptions) -> tuple[tuple[float, float], Footprint | None]:
    """Height of the mount and reach (m), and the base where one is given."""
    from datagen.train.prediction import read_footprint

    size = (_required(given.base_height, "--base-height"), _required(given.reach, "--reach"))
    return size, None if given.footprint is None else read_footprint(given.footprint)


def refuse_robot(given: PredictOptions) -> None:
    """Raise InputError where `predict` would, whatever the frame: for the robot and its sizes."""
    _sizes(given if given.robot is None else _of_robot(given, given.robot)[0])


def _required(value: T | None, option: str) -> T:
    if value is None:
        fix = "Name a frame, or a recording with --bag" if option == "--frame" else "Give it in metres"
        raise InputError(option, "", "is missing", fix)
    return value


def _direction(given: Sequence[float]) -> F64:
    values = np.array(given, np.float64)
    sound = values.shape == (3,) and bool(np.isfinite(values).all())
    if not sound or not 1e-6 < float(np.abs(values).max()) < 1e6:
        fix = "Give x,y,z in the camera frame: 0,1,0 for a level camera"
        raise InputError("--gravity", ",".join(f"{value:g}" for value in given), "is not a direction", fix)
    return values


def _refuse_outputs(out: Path | None, html: Path | None, goal: Path | None, read: Sequence[Any]) -> None:
    """Raise InputError for an output that is a folder or is among the files to `read`."""
    from datagen.train.prediction.frames import frame_files
    from datagen.train.prediction.goals import ENDINGS, goal_files

    if html is not None:
        import_module("datagen.train.prediction.page")  # reports a missing library before scoring
    if goal is not None and goal.suffix == ".mcap":
        import_module("rosbags")
    paths = [Path(each) for each in read if isinstance(each, (str, Path))]
    of_folders = [file for path in paths if path.is_dir() for file in frame_files(path).values()]
    taken = {each.resolve() for each in (*paths, *of_folders)}
    for option, file, endings in (
        ("--out", out, (".png", ".pdf", ".svg")),
        ("--html", html, (".html",)),
        ("--goal", goal, ENDINGS),
    ):
        if file is None:
            continue
        refuse_output(file, option, *endings)
        for each in goal_files(file):
            if each.is_dir() or each.resolve() in taken:
                problem = "is a folder" if each.is_dir() else "is a file of the input"
                raise InputError(each, option, problem, "Give another name")
