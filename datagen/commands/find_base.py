"""`datagen.find_base`: a base pose from the arrays of a depth camera, without files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from datagen.commands.predict import predict
from datagen.schemas.errors import InputError

if TYPE_CHECKING:
    from datagen.train.prediction import Prediction

_FIX = (
    "Give rgb (H, W, 3) as uint8, depth (H, W) in metres or as uint16 in millimetres, and K (3, 3) in pixels"
)


def find_base(
    rgb: npt.ArrayLike,
    depth: npt.ArrayLike,
    K: npt.ArrayLike,
    T_map_camera: npt.ArrayLike | None = None,
    *,
    mask: npt.ArrayLike | None = None,
    map: Any = (),  # noqa: A002
    **options: Any,
) -> Prediction:
    """Find where to park the base to grasp an object that a depth camera sees.

    Args:
        rgb: Colours (H, W, 3), uint8.
        depth: Depth (H, W) along the camera's z axis, aligned with `rgb`: metres, or millimetres as uint16;
            0 or NaN where not measured.
        K: Intrinsics (3, 3) of the undistorted picture, in pixels.
        T_map_camera: Pose (4, 4) of the camera (x right, y down, z ahead) in the map, its floor at z = 0.
            Without it give `camera_height`.
        mask: Pixels (H, W) of the object; or give `click=(u, v)` or `box=(left, top, right, bottom)`.
        map: `OccupancyMap`, or a map.yaml of Nav2, or a list of these.
        options: As of `datagen.predict`: `robot`, or `base_height` and `reach`; `arrival`, `allow_unseen`.

    Returns:
        The answer, as of `datagen.predict`; notebooks show it as a picture.

    Raises:
        InputError: An array or an option cannot be used.

    Examples:
        >>> rgb, depth, K, T_map_camera, mask = camera
        >>> answer = datagen.find_base(
        ...     rgb, depth, K, T_map_camera, mask=mask, base_height=0.7, reach=0.9, allow_unseen=True
        ... )
        >>> answer.score.shape
        (676,)
    """
    from datagen.train.prediction.files import checked_pose, scaled_depth
    from datagen.train.prediction.frames import Pinhole, RgbdImage, image_frame

    colours, metres, k = np.asarray(rgb), np.asarray(depth), np.asarray(K, np.float64)
    shapes = {"rgb": colours.shape == (*metres.shape, 3), "depth": metres.ndim == 2, "K": k.shape == (3, 3)}
    types = {"rgb": colours.dtype == np.uint8, "depth": metres.dtype.kind == "f" or metres.dtype == np.uint16}
    for name, value in (("rgb", colours), ("depth", metres), ("K", k)):
        if not (shapes[name] and types.get(name, True)):
            raise InputError("datagen.find_base", name, f"is {value.dtype} of shape {value.shape}", _FIX)
    if not (np.isfinite(k).all() and k[0, 0] >= 1 and k[1, 1] >= 1):
        raise InputError("datagen.find_base", "K", "has no focal lengths of a pixel or more", _FIX)
    chosen = None if mask is None else np.asarray(mask).astype(np.bool_)
    pinhole = Pinhole(*(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))
    depth_m, step_m, notes = scaled_depth(metres, None, "depth")
    image = RgbdImage(colours, depth_m, pinhole, chosen, step_m=step_m, notes=notes)
    T = None if T_map_camera is None else checked_pose(np.asarray(T_map_camera, np.float64), "T_map_camera")
    maps = map if isinstance(map, list | tuple) else [map]
    return predict(frame=[image_frame(image, T, {})], map=maps, **options)
