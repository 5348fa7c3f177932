"""Meshes for engines with one texture per body: no shared corners, flat colours as a palette."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F32, U8, Mesh

_PALETTE_WIDTH = 256


def face_texture(mesh: Mesh) -> tuple[F32, U8]:
    """Texture coordinates (F, 3, 2) of the faces' corners and their image (H, W, 3).

    A textured mesh gives its own. Flat face colours become texels of a palette, with all three
    corners of a face in the middle of the same one. The origin is the image's lower left corner.
    """
    if mesh.texture is not None:
        return mesh.texture.uv[mesh.faces], mesh.texture.image
    colours, index = np.unique(mesh.face_rgb, axis=0, return_inverse=True)
    height = max(1, -(-len(colours) // _PALETTE_WIDTH))
    image = np.zeros((height * _PALETTE_WIDTH, 3), np.uint8)
    image[: len(colours)] = colours
    row, column = np.divmod(index.ravel(), _PALETTE_WIDTH)
    uv = np.stack([(column + 0.5) / _PALETTE_WIDTH, 1 - (row + 0.5) / height], axis=1).astype(np.float32)
    return np.repeat(uv[:, None], 3, axis=1), image.reshape(height, _PALETTE_WIDTH, 3)
