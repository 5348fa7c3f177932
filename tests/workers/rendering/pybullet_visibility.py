"""Visible pixels by pybullet's TinyRenderer, to hold those by Embree against."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64, I32
from datagen.workers.geometry.transforms import look_at
from datagen.workers.rendering import Camera, SceneGeometry
from tests.workers.rendering.pybullet_renderer import Drawing

_NEAR_M = 0.001  # shows the wall that an eye stands in


class PybulletScene(ExitStack):
    """A scene loaded once, for many looks; a context manager that frees it at the end."""

    def __init__(self, scene: SceneGeometry) -> None:
        super().__init__()
        self._scene = scene
        self._alone: dict[int, Drawing] = {}
        self._full = self.enter_context(Drawing())
        self._full.add_scene(scene)

    def visible_pixels(self, target: int, eyes_m: F64, window: int) -> tuple[I32, I32]:
        """Pixels (N,) on the target when alone, and of them those that show it in the full scene.

        The same cameras as `datagen.workers.rendering.visibility.visible_pixels`: each eye (N, 3) looks at
        the target's centre through `window` x `window` pixels that touch its bounding sphere.
        """
        if target not in self._alone:
            self._alone[target] = self.enter_context(Drawing())
            visual, T_world_target = self._scene.objects[target].visual, self._scene.T_world_object[target]
            self._alone[target].add(visual, T_world_target, 1 + target)
        alone_px, visible_px = np.zeros(len(eyes_m), np.int32), np.zeros(len(eyes_m), np.int32)
        centre_m = self._scene.T_world_object[target, :3, 3]
        radius_m = self._scene.objects[target].radius_m
        for row, eye_m in enumerate(eyes_m):
            distance_m = float(np.linalg.norm(eye_m - centre_m))
            if distance_m <= radius_m * 1.05:
                continue
            sine = radius_m / distance_m
            f_px = window / 2 * np.sqrt(1 - sine**2) / sine
            camera = Camera(look_at(eye_m, centre_m), window, window, f_px, f_px, window / 2, window / 2)
            on_target = _shows(self._alone[target], camera, 1 + target)
            alone_px[row] = on_target.sum()
            visible_px[row] = (on_target & _shows(self._full, camera, 1 + target)).sum()
        return alone_px, visible_px


def _shows(drawing: Drawing, camera: Camera, label: int) -> npt.NDArray[np.bool_]:
    return drawing.render(camera, _NEAR_M).body == label
