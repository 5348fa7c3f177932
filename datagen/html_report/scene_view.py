"""The interactive view of a scene on the page: its point cloud and base poses."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from datagen.display.html_page import escape
from datagen.display.styles import LABEL_STYLES, TARGET
from datagen.schemas.fields import SceneRows
from datagen.schemas.outcomes import OUTCOMES

SCRIPT = files("datagen.html_report").joinpath("scene_view.js").read_text(encoding="utf-8")
STYLE = """
.scene { border-top: 1px solid var(--line); padding-top: .2rem; }
.pictures { display: grid; gap: .8rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); }
.pictures figure { margin: 0; }
.pictures img, .scene-view canvas { display: block; width: 100%; height: auto; }
.scene-view canvas { aspect-ratio: 4 / 3; touch-action: pan-y; cursor: grab; border-radius: 4px; }
.scene-view canvas:focus-visible { outline: 3px solid #0b57a4; }
.scene-view .buttons { display: flex; flex-wrap: wrap; gap: .3rem; margin: .4rem 0; }
.scene-view button { font: inherit; min-width: 2.1rem; min-height: 2.2rem; padding: .1rem .4rem;
  cursor: pointer;
  color: #1b1f24; background: #f3f6f9; border: 1px solid #b7c0c9; border-radius: 5px; }
.scene-view output { display: block; min-height: 1.5em; font-size: .92rem; }
"""
_MOST_UNITS = 32767
_SIDEWAYS_RAD = 0.35
_SHOWN_PERCENT = 95
VIEW_HELP = (
    "Drag a view to turn it, pinch to zoom. With a view in focus: arrow keys turn, + and - or the wheel "
    "zoom, n and p step through the base poses, Home resets. Blue discs are good, orange triangles bad; "
    "marks are hollow where the base collides. The target is pink; the grid on the floor has cells of 0.5 m."
)
_BUTTONS = (
    ("ArrowLeft", "←", "turn left"),
    ("ArrowRight", "→", "turn right"),
    ("ArrowUp", "↑", "look from above"),
    ("ArrowDown", "↓", "look from the side"),
    ("+", "+", "zoom in"),
    ("-", "−", "zoom out"),
    ("n", "next", "choose the next base pose"),
    ("Home", "reset", "reset the view"),
)


def scene_view(rows: SceneRows, name: str) -> str:
    """The view of a scene as HTML; `name` is its label for screen readers."""
    buttons = "".join(
        f'<button type="button" data-key="{key}" title="{title}" aria-label="{title}">{text}</button>'
        for key, text, title in _BUTTONS
    )
    return (
        f'<figure class="scene-view"><canvas tabindex="0" role="img" aria-label="{escape(name)}"></canvas>'
        f'<div class="buttons">{buttons}</div><output aria-live="polite"></output>'
        f'<script type="application/json">{_embedded(_scene_data(rows))}</script></figure>'
    )


def _embedded(value: Any) -> str:
    """JSON that cannot close the HTML element that contains it."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _scene_data(rows: SceneRows) -> dict[str, Any]:
    """Cloud and base poses in the target's frame (m). The cloud's coordinates are multiples of `unit`."""
    record, samples = rows.record, rows.samples
    n = int(record["n_points"])
    points_m = np.asarray(record["points_m"][:n], np.float64)
    finite = np.isfinite(points_m).all(axis=1)
    points_m = points_m[finite]
    unit_m = max(float(np.abs(points_m).max(initial=0.0)), 0.001) / _MOST_UNITS
    center_m = np.asarray(record["target_center_m"], np.float64)
    base_m = np.asarray(samples["base_xy_m"], np.float64) - center_m[:2]
    floor_m = -float(center_m[2])
    # Points far off or high up, such as walls, may be cut off.
    top_m = float(np.percentile(points_m[:, 2], _SHOWN_PERCENT)) if len(points_m) else 0.0
    wide_m = float(np.percentile(np.abs(points_m[:, :2]), _SHOWN_PERCENT)) if len(points_m) else 0.0
    base_radius_m = float(np.linalg.norm(base_m, axis=1).max(initial=0.0))
    # Radius of a ball that contains cloud and base poses.
    radius_m = max(0.5, float(np.hypot(max(wide_m, base_radius_m), (top_m - floor_m) / 2)))
    return {
        "points": _packed(np.round(points_m / unit_m).astype("<i2")),
        "unit": unit_m,
        "rgb": _packed(np.asarray(record["rgb"][:n], np.uint8)[finite]),
        "target": _packed(np.asarray(record["target_mask"][:n]).astype(np.uint8)[finite]),
        "floor": floor_m,
        "middle": (floor_m + top_m) / 2,
        "radius": round(radius_m, 3),
        "yaw": _first_yaw_rad(np.asarray(record["T_world_camera"], np.float64)[:2, 3] - center_m[:2]),
        "candidates": _candidates(samples, base_m),
        "colours": {"good": LABEL_STYLES[1].colour, "bad": LABEL_STYLES[0].colour, "target": TARGET.colour},
    }


def _first_yaw_rad(to_camera_m: np.ndarray[Any, Any]) -> float:
    """The first yaw of the view, a little to the side of the observation camera."""
    x, y = to_camera_m.tolist()
    return round(float(np.arctan2(x, -y)) + _SIDEWAYS_RAD, 3)


def _packed(values: np.ndarray[Any, Any]) -> str:
    return b64encode(np.ascontiguousarray(values).tobytes()).decode()


def _candidates(samples: Any, base_m: np.ndarray[Any, Any]) -> list[list[Any]]:
    """Each base pose: x, y, label, whether the base fits, and its name."""
    words = [str(k) for k in np.asarray(samples["candidate_index"]).tolist()]
    if "outcome" in samples:
        names: Sequence[str] = tuple(OUTCOMES)
        words = [f"{k} ({names[code]})" for k, code in zip(words, samples["outcome"], strict=True)]
    columns = (
        np.round(base_m, 3).tolist(), np.asarray(samples["label"]).tolist(),
        np.asarray(samples["base_is_clear"]).astype(int).tolist(), words,
    )  # fmt: skip
    return [[x, y, label, clear, text] for (x, y), label, clear, text in zip(*columns, strict=True)]
