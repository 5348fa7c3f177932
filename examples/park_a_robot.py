"""Ask a trained model where a robot should park, in the frame of its map.

Usage: python examples/park_a_robot.py [FOLDER]   (after examples/train_on_labels.py [FOLDER])

The camera here is a stored view of FOLDER/val. On a robot fill the same SensorFrame with points of the depth
camera, a mask of the target, and the camera's pose in the map; or name a folder or .npz file instead.
"""

import math
import sys
from pathlib import Path

import numpy as np

import datagen


def look(folder: Path) -> datagen.SensorFrame:
    """The camera's frame of the first scene: points in its own frame, and its pose in the map."""
    scene = datagen.open_dataset(folder / "val").isel(scene=0)
    n = int(scene["n_points"])
    T_map_camera = scene["T_world_camera"].values  # map: z up, floor at z = 0
    points_map = scene["points_m"].values[:n].astype(np.float64) + scene["target_center_m"].values
    points_camera = (points_map - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    return datagen.SensorFrame(
        place="depth camera",
        points_m=points_camera.astype(np.float32),
        rgb=scene["rgb"].values[:n],
        on_target=scene["target_mask"].values[:n],
        T_world_camera=T_map_camera,
        image=None,
    )


def main(folder: Path) -> None:
    fetch = datagen.robots["fetch"]
    answer = datagen.predict(
        folder / "model.ckpt",
        frame=[look(folder)],
        reach=fetch.reach_m[1],
        base_height=fetch.base_height_m[0],
        allow_unseen=True,  # the stored view is cut to 1 m around the target and shows little floor
    )
    print("; ".join([answer.level, *answer.reasons]))
    if answer.best is None:
        return
    x, y = answer.base_xy_m[answer.best]
    yaw_deg = math.degrees(answer.yaw_rad[answer.best])
    print(f"park at x {x:.2f} m, y {y:.2f} m, yaw {yaw_deg:.0f} degrees in the map, facing the target")
    print(f"score {answer.score[answer.best]:.2f}; T_map_mount:\n{answer.T_world_base(answer.best).round(3)}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-runs"))
