"""A prediction as one HTML page with a view to rotate; it needs no other file and no network."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.colors import get_colorscale
from plotly.io import to_html

from datagen.display.figures import new_sheet, save_sheet
from datagen.display.styles import BEST, SCORE_COLOURS, TARGET
from datagen.schemas.errors import printable
from datagen.train.inputs import F64
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import STATES
from datagen.train.prediction.pictures import draw_plan, draw_view, shown_rows
from datagen.train.prediction.prediction_report import report_rows

_MOST_POINTS = 20_000
_SYMBOLS = {
    "clear": "square",
    "blocked": "circle-open",
    "unseen": "square-open",
    "unreachable": "diamond-open",
}
_TARGET_RGB = tuple(int(TARGET.colour[k : k + 2], 16) for k in (1, 3, 5))
_CAPTION = (
    "The cloud with the target in pink, and the grid of base poses, from red (score 0) to blue (1). Drag "
    "to turn, scroll or pinch to zoom, point at a square to read its score. Gold is the robot at the best "
    "pose: its base, its heading, and the camera's mast."
)
_STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1b1f24; --pale: #59636e; --accent: #0b57a4; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #14181d; --ink: #e6eaef; --pale: #a3afbb; --accent: #7db8f5; } }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 78rem; padding: 0 1rem 3rem; border-top: 6px solid var(--accent); }
h1 { font-size: 1.6rem; line-height: 1.25; overflow-wrap: anywhere; }
figure { margin: .6rem 0 1.2rem; padding: .4rem; background: #ffffff; color: #1b1f24;
  border: 1px solid var(--pale); border-radius: 6px; overflow-x: auto; }
figure img { max-width: 100%; vertical-align: top; }
figcaption { font-size: .92rem; color: #59636e; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: .6rem 0; }
dt { color: var(--pale); }
dd { margin: 0; min-width: 0; grid-column: 2; overflow-wrap: anywhere; }
@media (max-width: 40rem) { dl { display: block; } dd { margin-bottom: .4rem; } h1 { font-size: 1.35rem; } }
"""
_COLOURBAR = {"title": {"text": "score"}, "orientation": "h", "y": 1, "yanchor": "bottom", "thickness": 12}


def page_of(prediction: Prediction) -> str:
    """The page: facts, and the cloud with every base pose, its score under the pointer, the best in gold."""
    x, y = prediction.seen.eyes_m[0, :2] - prediction.center_m[:2]
    eye = np.round(2.05 * np.array([x, y]) / np.hypot(x, y), 3).tolist()  # on the camera's side
    layout = go.Layout(
        template="plotly",
        margin={"l": 0, "r": 0, "b": 0, "t": 0},
        paper_bgcolor="#ffffff",
        scene={
            "aspectmode": "data",
            "camera": {"eye": {"x": eye[0], "y": eye[1], "z": 1.15}, "center": {"x": 0, "y": 0, "z": -0.2}},
            **{f"{axis}axis": {"title": f"{axis} [m]", "nticks": 5} for axis in "xyz"},
        },
        legend={"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"},
    )
    traces = [_cloud(prediction), *_base_poses(prediction), *_best(prediction)]
    # Without validation: plotly would take seconds for twenty thousand colours.
    view = to_html(
        {"data": [{**trace, "type": "scatter3d"} for trace in traces], "layout": layout.to_plotly_json()},
        validate=False, include_plotlyjs=True,
        full_html=False, div_id="prediction", default_height="min(40rem, 112vw)",
        config={"responsive": True, "displaylogo": False},
    )  # fmt: skip
    title = escaped(f"Base poses scored by {prediction.scorer}")
    rows = ((head, escaped(text)) for head, text in report_rows(prediction))
    # A text without a heading belongs to the one above.
    facts = "".join((f"<dt>{escaped(head)}</dt>" if head else "") + f"<dd>{text}</dd>" for head, text in rows)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{_STYLE}</style></head>\n<body>\n<h1>{title}</h1>\n"
        f"<figure>{_views(prediction)}</figure>\n<dl>{facts}</dl>\n"
        f'<figure tabindex="0">{view}<figcaption>{escaped(_CAPTION)}</figcaption></figure>\n</body></html>\n'
    )


def escaped(text: str) -> str:
    """The text escaped for HTML, without markup or control characters."""
    return escape(printable(text))


def _views(prediction: Prediction) -> str:
    text = ""
    for draw, height_in in ((draw_view, 4.0), (draw_plan, 5.2)):
        figure, drawn = new_sheet("", height_in, 5.0), BytesIO()  # 5 inches: readable text on a phone
        draw(axes := figure.subplots(), prediction)
        if axes.has_data():  # clouds from files have no image
            save_sheet(figure, drawn)
            png = b64encode(drawn.getvalue()).decode()
            text += f'<img alt="{axes.get_title()}" src="data:image/png;base64,{png}">'
    return text


def _cloud(prediction: Prediction) -> dict[str, Any]:
    rows = shown_rows(prediction, _MOST_POINTS, float(np.abs(prediction.cells.offset_m).max()) + 0.5)
    points, rgb = prediction.seen.points_m[rows], prediction.seen.rgb[rows].copy()
    rgb[prediction.seen.on_target[rows]] = _TARGET_RGB
    marker = {"size": 1.8, "color": [f"rgb({r},{g},{b})" for r, g, b in rgb.tolist()]}
    look = {"mode": "markers", "marker": marker, "hoverinfo": "skip", "name": "cloud, target pink"}
    return _at(points.astype(np.float64)) | look


def _base_poses(prediction: Prediction) -> list[dict[str, Any]]:
    traces: list[dict[str, Any]] = []
    for state in STATES:
        rows = prediction.rows(state)
        if not len(rows):
            continue
        xy, scores = prediction.base_xy_m[rows], prediction.score[rows]
        texts = [
            f"{state}<br>score {s:.3f}<br>x {x:.3f} m, y {y:.3f} m<br>yaw {w:.1f} deg"
            for s, (x, y), w in zip(scores, xy, np.degrees(prediction.yaw_rad[rows]), strict=True)
        ]
        marker = {
            **{"size": 3 if state in ("blocked", "unreachable") else 6, "symbol": _SYMBOLS[state]},
            **{"color": scores.tolist(), "colorscale": get_colorscale(SCORE_COLOURS), "cmin": 0, "cmax": 1},
            **{"showscale": not traces, "colorbar": _COLOURBAR},
        }
        look = {"mode": "markers", "marker": marker, "text": texts, "hoverinfo": "text"}
        place = _at(np.column_stack([xy, np.full(len(rows), 0.01)]))
        traces.append(place | look | {"name": f"{len(rows)} {state}"})
    return traces


def _best(prediction: Prediction) -> list[dict[str, Any]]:
    """The robot at the best pose: outline of its base at two heights, heading, and the camera's mast."""
    if (row := prediction.best) is None:
        return []
    robot, xy, yaw = prediction.robot, prediction.base_xy_m[row], float(prediction.yaw_rad[row])
    ring = robot.outline.outline(xy, yaw)
    ring, tip = np.concatenate([ring, ring[:1]]), xy + 0.35 * np.array([np.cos(yaw), np.sin(yaw)])
    wings = [tip + 0.12 * np.array([np.cos(yaw + turn), np.sin(yaw + turn)]) for turn in (2.6, -2.6)]
    arrow = np.array([xy, tip, wings[0], tip, wings[1]])
    lines = [(line, (z,) * len(line)) for z in (0.01, robot.base_height_m) for line in (ring, arrow)]
    lines += [(np.array([xy, xy]), (0.01, max(robot.camera_height_m, robot.base_height_m)))]
    gap = np.full((1, 3), np.nan)  # ends a line
    path = np.concatenate([part for line, z in lines for part in (np.column_stack([line, z]), gap)])
    look = {"mode": "lines", "line": {"color": BEST.colour, "width": 6}, "connectgaps": False}
    name = f"best, score {prediction.score[row]:.3f}"
    return [_at(path) | look | {"name": name, "hoverinfo": "name"}]


def _at(points_m: F64) -> dict[str, Any]:
    """Points (N, 3) as plotly's coordinates; nan ends a line."""
    columns = [[None if np.isnan(v) else round(float(v), 4) for v in column] for column in points_m.T]
    return dict(zip("xyz", columns, strict=True))
