"""Flat face colours as a palette: every corner of a face finds the face's own colour."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.geometry.mesh import Mesh, face_normals, face_texture


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1500), st.integers(1, 2000), st.integers(0, 2**32 - 1))
def test_looking_a_corner_up_gives_the_colour_of_its_face(n_faces: int, n_colours: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    colours = rng.integers(0, 256, (n_colours, 3)).astype(np.uint8)[rng.integers(0, n_colours, n_faces)]
    mesh = Mesh(np.zeros((3, 3), np.float32), np.zeros((n_faces, 3), np.int32), colours)
    uv, image = face_texture(mesh)
    assert uv.shape == (n_faces, 3, 2)
    height, width = image.shape[:2]
    column, row = (uv[..., 0] * width).astype(int), ((1 - uv[..., 1]) * height).astype(int)
    np.testing.assert_array_equal(image[row, column], np.repeat(colours[:, None], 3, axis=1))


def test_normals_follow_the_corners_and_faces_without_area_have_none() -> None:
    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 3, 0]], [[1, 1, 1]] * 3], np.float32)
    np.testing.assert_array_equal(face_normals(corners), [[0, 0, 1], [0, 0, 0]])
