"""The options of `datagen predict`, and what is wrong with them before a frame is read."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, Token

from datagen.console.options import AsJson, File
from datagen.schemas.errors import InputError

if TYPE_CHECKING:
    from datagen.train.prediction import Footprint
    from datagen.train.prediction.frames import SensorFrame
    from datagen.train.scorers import Scorer
    from datagen.workers.occupancy_map import OccupancyMap

    Frames = Sequence[str | Path | SensorFrame]
    Maps = Sequence[str | Path | OccupancyMap]
    Checkpoint = str | Path | Scorer
    Outline = str | float | Sequence[Sequence[float]] | Footprint
else:
    # Types that the command line resolves without importing torch.
    Frames, Maps, Checkpoint, Outline = Sequence[Path], Sequence[Path], str | Path, str

UNSET = Parameter(show_default=False)  # an empty list says nothing
OUTLINE = Parameter(  # corners may begin with a minus
    converter=lambda kind, tokens: tokens[0].value, n_tokens=1, metavar="STR", allow_leading_hyphen=True
)
_LARGEST_M = 10.0


def _pixels(option: str, count: int, problem: str, fix: str) -> Parameter:
    def read(kind: Any, tokens: Sequence[Token]) -> tuple[int, ...]:
        parts = (text := tokens[0].value).split(",")
        if len(parts) != count or not all(re.fullmatch(r"\s*[0-9]{1,6}\s*", p, re.ASCII) for p in parts):
            raise InputError(option, text[:40], problem, fix)
        return tuple(map(int, parts))

    return Parameter(converter=read, n_tokens=1, metavar="STR")


_CLICK = _pixels("--click", 2, "is not a pixel", "Give column and row as u,v: 320,240")
_BOX = _pixels("--box", 4, "is no box", "Give LEFT,TOP,RIGHT,BOTTOM in pixels: 280,200,360,300")


def _numbers(kind: Any, tokens: Sequence[Token]) -> list[float]:
    try:
        return [float(part) for part in tokens[0].value.split(",")]
    except ValueError:
        return []


@dataclass(frozen=True)
class PredictOptions:
    """Options of `predict`.

    Args:
        checkpoint: Checkpoint of `datagen train`; in Python also a scorer of `datagen.load_scorer`
            [default: the released model]
        robot: Robot, or its file ROBOT.toml: gives its heading, and what is not given of its mount's height,
            reach and base.
        base_height: Height of the arm's mount above the floor (m).
        reach: Reach of the arm from its mount (m).
        demo: Predict on the frame that ships with the package; writes demo.png and, with the extra train,
            demo.html.
        export: New folder for the frame of --demo or --bag; of --bag also where no target is given yet.
        frame: Frame as a folder, .npz, .ply or .pcd; several with poses are fused.
        bag: Recording of ROS 2 in place of frames: .mcap, .db3 or a folder of rosbag2, with tf.
        at: Seconds from the start of the recording to its frame; several frames are fused.
            [default: the last frame]
        topic: Topic of the recording, where several fit: color, depth, color_info, depth_info or map=TOPIC.
        click: Pixel u,v on the target in the first frame, where it has no mask.
        box: Box LEFT,TOP,RIGHT,BOTTOM (pixels) around the target in the first frame, in place of a click.
        camera_height: Height of the frame's camera (m), where it has no pose.
        gravity: Direction of gravity x,y,z in the camera frame (x right, y down).
        robot_camera_height: Height of the robot's own camera (m). [default: that of the frame's camera]
        footprint: Base: radius (m), corners x,y;x,y;... around the mount, x ahead; or a robot.
            [default: as trained]
        depth_scale: Metres per step of depth below 1 (0.001), else steps per metre (1000, 5000).
            [default: millimetres; floats in metres]
        allow_unseen: Also consider cells of which the floor, or the way there, was not seen.
        map: Map of the floor, map.yaml as Nav2 has it, in which the frames have their poses; repeatable.
        keep_out: Map of which no base may stand on occupied cells, FILE.yaml.
        arrival: Arrival error to choose for: normal:M[,YAW], disc:M[,YAW] or nav2.
        out: Picture to write, FILE.png, .pdf or .svg.
        html: Page to write, FILE.html.
        goal: Goal for the robot's base to write, FILE.yaml or .mcap; FILE.pgm: the scores as a map.
    """

    checkpoint: Annotated[Checkpoint | None, Parameter(name="CHECKPOINT")] = None
    _: KW_ONLY
    robot: str | None = None
    base_height: float | None = None
    reach: float | None = None
    demo: bool = False
    export: File | None = None
    frame: Frames | None = None
    bag: File | None = None
    at: Annotated[Sequence[float], UNSET] = ()
    topic: Annotated[Sequence[str], UNSET] = ()
    click: Annotated[tuple[int, int] | None, _CLICK] = None
    box: Annotated[tuple[int, int, int, int] | None, _BOX] = None
    camera_height: float | None = None
    gravity: Annotated[
        Sequence[float] | None,
        Parameter(converter=_numbers, n_tokens=1, metavar="STR", allow_leading_hyphen=True),
    ] = None
    robot_camera_height: float | None = None
    footprint: Annotated[Outline | None, OUTLINE] = None
    depth_scale: float | None = None
    allow_unseen: bool = False
    map: Annotated[Maps, UNSET] = ()
    keep_out: Annotated[Maps, UNSET] = ()
    arrival: str | None = None
    out: File | None = None
    html: File | None = None
    goal: File | None = None
    json: AsJson = False

    def __post_init__(self) -> None:
        """Raise InputError for options that are out of range or do not go together."""
        if self.demo and not (self.frame is self.click is self.box is self.bag is None):
            fix = "Omit --demo to predict on a frame of your own"
            raise InputError("--demo", "", "has a frame and a click of its own", fix)
        has_frame = self.demo or self.bag is not None
        if self.export is not None and (not has_frame or Path(self.export).exists()):
            problem = "exists already" if has_frame else "is given without --demo or --bag"
            raise InputError("--export", str(self.export), problem, "Name a new folder, with one of them")
        if self.bag is not None and self.frame is not None:
            raise InputError("--bag", "", "is given with --frame", "Give one of them")
        if self.bag is None and (self.at or self.topic):
            raise InputError("--at" if self.at else "--topic", "", "is for --bag", "Name the recording")
        for name in ("base_height", "reach", "camera_height", "robot_camera_height"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and 0 < value <= _LARGEST_M):
                option, problem = f"--{name.replace('_', '-')}", f"is not between 0 and {_LARGEST_M:g}"
                raise InputError(option, f"{value:g}", problem, "Give it in metres")
        if self.bag is not None and self.depth_scale is not None:
            fix = "Omit it: depth of recordings is in millimetres, or in metres as floats (REP 118)"
            raise InputError("--depth-scale", "", "is given with --bag", fix)
        if self.depth_scale is not None and not 1e-6 <= self.depth_scale <= 1e6:
            fix = "Give metres per step, or steps per metre: 0.001 or 1000 for millimetres"
            raise InputError(
                "--depth-scale", str(self.depth_scale), "is not between 0.000001 and 1000000", fix
            )
