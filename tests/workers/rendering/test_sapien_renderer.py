"""SAPIEN's frames against Embree's where there is a render device, and a plain word where not."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip(
    "sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`", exc_type=ImportError
)

from datagen.schemas.errors import InputError
from datagen.workers.rendering import Camera, Frame, SceneGeometry
from datagen.workers.rendering.embree import render_embree
from datagen.workers.rendering.sapien_renderer import render_sapien
from tests.conftest import REPOSITORY
from tests.workers.rendering.engines import assert_same_hues, assert_same_view, cameras, mixed_stage
from tests.workers.worlds import camera_at


def rendered(stage: SceneGeometry, camera: Camera) -> Frame:
    try:
        return render_sapien(stage, camera)
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("camera", cameras())
def test_frames_agree_with_embree(camera: Camera) -> None:
    stage = mixed_stage()
    frame = rendered(stage, camera)
    assert_same_view(frame, render_embree(stage, camera))


def test_textures_are_where_they_belong() -> None:
    stage = mixed_stage()
    above = camera_at((1.9, 1.6, 1.5), (1.9, 1.7, 0.75), 160, 120, 300.0)
    assert_same_hues(rendered(stage, above), render_embree(stage, above), 4)


def test_earlier_frames_do_not_change_later_ones() -> None:
    stage, camera = mixed_stage(), cameras()[0]
    first = rendered(stage, camera)
    rendered(SceneGeometry(stage.house, stage.objects[::-1], stage.T_world_object), camera)
    again = rendered(stage, camera)
    assert (first.body == again.body).all()
    assert (first.depth_m == again.depth_m).all()


def test_without_a_render_device_the_error_names_the_fix() -> None:
    program = (
        "from datagen.schemas.errors import InputError\n"
        "from tests.workers.rendering.engines import cameras, mixed_stage\n"
        "from datagen.workers.rendering.sapien_renderer import render_sapien\n"
        "try:\n    render_sapien(mixed_stage(), cameras()[0])\n"
        "except InputError as error:\n    print(error)\n"
    )
    nowhere = {"VK_DRIVER_FILES": "/nowhere.json", "VK_ICD_FILENAMES": "/nowhere.json"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=REPOSITORY,
        env={**os.environ, **nowhere},
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    assert done.stdout.startswith("observation.renderer: sapien: finds no render device")
    assert "datagen doctor" in done.stdout and "choose embree" in done.stdout
    assert done.stdout.count("\n") == 1
