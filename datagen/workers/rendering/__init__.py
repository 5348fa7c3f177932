"""RGB-D frames of a scene. RENDERERS is the registry; each engine lives in one file."""

from __future__ import annotations

from datagen.workers.registry import entry
from datagen.workers.rendering.frame import Renderer

RENDERERS: dict[str, str] = {
    "embree": "datagen.workers.rendering.embree_renderer:render_embree",
    "pybullet": "datagen.workers.rendering.pybullet_renderer:render_pybullet",
    "sapien": "datagen.workers.rendering.sapien_renderer:render_sapien",
}


def load_renderer(name: str) -> Renderer:
    """The renderer of that name. Raises InputError where it is unknown or cannot be imported."""
    return entry(RENDERERS, name, "--renderer")
