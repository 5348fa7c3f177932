"""RGB-D frames of a scene. RENDERERS is the registry; each engine lives in one file."""

from __future__ import annotations

from importlib import import_module

from schemas.errors import InputError, choices
from workers.rendering.frame import Renderer

RENDERERS: dict[str, str] = {
    "embree": "workers.rendering.embree_renderer:render_embree",
    "pybullet": "workers.rendering.pybullet_renderer:render_pybullet",
    "sapien": "workers.rendering.sapien_renderer:render_sapien",
}


def load_renderer(name: str) -> Renderer:
    """The renderer of that name. Raises InputError where it is unknown or cannot be imported."""
    if name not in RENDERERS:
        raise InputError("--renderer", name, "no such renderer", choices(RENDERERS))
    module, function = RENDERERS[name].split(":")
    try:
        renderer: Renderer = getattr(import_module(module), function)
    except ImportError as error:
        mend = "Run `datagen doctor`, or take another one with --renderer"
        raise InputError("--renderer", name, f"cannot be imported here: {error}", mend) from error
    return renderer
