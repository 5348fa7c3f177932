"""RGB-D frames of a scene. RENDERERS is the registry; each engine lives in one file."""

from __future__ import annotations

from workers.registry import entry
from workers.rendering.frame import Renderer

RENDERERS: dict[str, str] = {
    "embree": "workers.rendering.embree_renderer:render_embree",
    "pybullet": "workers.rendering.pybullet_renderer:render_pybullet",
    "sapien": "workers.rendering.sapien_renderer:render_sapien",
}


def load_renderer(name: str) -> Renderer:
    """The renderer of that name. Raises InputError where it is unknown or cannot be imported."""
    renderer: Renderer = entry(RENDERERS, name, "--renderer")
    return renderer
