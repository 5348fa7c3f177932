"""Pictures of a scene for a page: the frame with the target outlined, and the room with the base poses."""

from __future__ import annotations

import io
from base64 import b64encode

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from datagen.display.figures import draw_frame
from datagen.drawing.floor_plan import draw_labels, draw_outcomes, draw_plan, half_width_m
from datagen.drawing.scene_picture import Shown
from datagen.schemas.fields import SceneRows
from datagen.schemas.specification import Specification
from datagen.workers.scenes.reconstruct import reconstruct_scene
from datagen.workers.world import World

_SIDE_IN, _DPI, _QUALITY = 5.2, 120, 82


def scene_pictures(world: World, run: str, spec: Specification, rows: SceneRows) -> tuple[str, str]:
    """The frame and the floor plan of a run's scene as `data:` addresses of WebP images."""
    shown = Shown(run, spec, rows, reconstruct_scene(world, rows.record))
    frame = _new_figure(0.8 * _SIDE_IN)
    draw_frame(frame.subplots(), shown.frame.rgb, shown.frame.body == 1, "")
    plan = _new_figure(1.08 * _SIDE_IN)
    axes, samples = plan.subplots(), shown.samples
    xy = np.asarray(samples["base_xy_m"], np.float64)
    half_m = max(half_width_m(shown.recalled), _widest_m(xy, shown) + 0.12)
    draw_plan(axes, shown.recalled, half_m, faded="outcome" in samples)
    clear = np.asarray(samples["base_is_clear"])
    if "outcome" in samples:
        handles = draw_outcomes(axes, xy, samples["outcome"], clear)
    else:
        handles = draw_labels(axes, xy, np.asarray(samples["label"]), clear)
    plan.legend(handles=handles, loc="outside lower left", frameon=False, fontsize=9, ncols=1)
    return _image(frame), _image(plan)


def _widest_m(base_xy_m: np.ndarray[tuple[int, int], np.dtype[np.float64]], shown: Shown) -> float:
    return float(np.abs(base_xy_m - shown.recalled.target_center_m[:2]).max(initial=0.0))


def _new_figure(height_in: float) -> Figure:
    figure = Figure(figsize=(_SIDE_IN, height_in), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _image(figure: Figure) -> str:
    with io.BytesIO() as drawn, io.BytesIO() as packed:
        figure.savefig(drawn, format="png")
        Image.open(drawn).convert("RGB").save(packed, format="webp", quality=_QUALITY, method=4)
        return "data:image/webp;base64," + b64encode(packed.getvalue()).decode()
