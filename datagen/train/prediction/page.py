"""A prediction as one HTML page with a view to rotate; it needs no other file and no network."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.colors import get_colorscale
from plotly.io import to_html

from datagen.display.html_page import html_facts, html_figure, html_page
from datagen.display.styles import BEST, SCORE_COLOURS, TARGET
from datagen.train.inputs import I64
from datagen.train.prediction.base_cells import STATES
from datagen.train.prediction.pictures import robot_lines, shown_rows
from datagen.train.prediction.predict import Prediction
from datagen.train.prediction.prediction_report import report_rows

_MOST_POINTS = 20_000
_SYMBOLS = {"clear": "square", "blocked": "x", "unseen": "square-open", "unreachable": "diamond-open"}
_TARGET_RGB = tuple(int(TARGET.colour[k : k + 2], 16) for k in (1, 3, 5))
_CAPTION = (
    "The cloud with the target in pink, and the grid of base poses, from red (score 0) to blue (1). Drag "
    "to turn, scroll or pinch to zoom, point at a square to read its score. Gold is the robot at the best "
    "pose: its base, the mount with the heading, and the camera's mast."
)


def page_of(prediction: Prediction) -> str:
    """The page: facts, and the cloud with every base pose, its score under the pointer, the best in gold."""
    half_m = float(np.abs(prediction.cells.offset_m).max()) + 0.5
    rows = shown_rows(prediction, _MOST_POINTS, half_m)
    traces = [_cloud(prediction, rows), *_base_poses(prediction), *_best(prediction)]
    layout = go.Layout(
        template="plotly",
        margin={"l": 0, "r": 0, "b": 0, "t": 0},
        paper_bgcolor="#ffffff",
        scene={
            "aspectmode": "data",
            "camera": {"eye": _first_eye(prediction), "center": {"x": 0, "y": 0, "z": -0.12}},
            **{f"{axis}axis": {"title": f"{axis} [m]", "nticks": 5} for axis in "xyz"},
        },
        legend={"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"},
    )
    # Without validation: plotly would take seconds for twenty thousand colours.
    view = to_html(
        {"data": [{**trace, "type": "scatter3d"} for trace in traces], "layout": layout.to_plotly_json()},
        validate=False, include_plotlyjs=True,
        full_html=False, div_id="prediction", default_height="min(40rem, 120vw)",
        config={"responsive": True, "displaylogo": False},
    )  # fmt: skip
    return html_page(
        f"Base poses scored by {prediction.scorer}",
        [html_facts(report_rows(prediction)), html_figure(view, _CAPTION)],
    )


def _first_eye(prediction: Prediction) -> dict[str, float]:
    """Initial eye of the view: above the target, on the side of the camera, which saw it."""
    x, y = prediction.seen.eyes_m[0, :2] - prediction.center_m[:2]
    azimuth = np.arctan2(y, x)
    return {"x": round(2.05 * np.cos(azimuth), 3), "y": round(2.05 * np.sin(azimuth), 3), "z": 1.15}


def _cloud(prediction: Prediction, rows: I64) -> dict[str, Any]:
    points, rgb = prediction.seen.points_m[rows], prediction.seen.rgb[rows].copy()
    rgb[prediction.seen.on_target[rows]] = _TARGET_RGB
    colours = [f"rgb({r},{g},{b})" for r, g, b in rgb.tolist()]
    x, y, z = np.round(points.astype(np.float64), 3).T.tolist()
    marker = {"size": 1.8, "color": colours}
    shown = {"mode": "markers", "marker": marker, "hoverinfo": "skip", "name": "cloud, target pink"}
    return {"x": x, "y": y, "z": z, **shown}


def _base_poses(prediction: Prediction) -> list[dict[str, Any]]:
    traces: list[dict[str, Any]] = []
    for state in STATES:
        rows = prediction.rows(state)
        if not len(rows):
            continue
        x, y = np.round(prediction.base_xy_m[rows], 4).T.tolist()
        yaw_deg = np.degrees(prediction.yaw_rad[rows])
        scores = prediction.score[rows]
        texts = [
            f"{state}<br>score {s:.3f}<br>x {a:.3f} m, y {b:.3f} m<br>yaw {w:.1f} deg"
            for s, a, b, w in zip(scores, x, y, yaw_deg, strict=True)
        ]
        marker = {
            "size": 3 if state in ("blocked", "unreachable") else 6,
            "symbol": _SYMBOLS[state],
            "color": scores.tolist(),
            "colorscale": get_colorscale(SCORE_COLOURS),
            "cmin": 0,
            "cmax": 1,
            "showscale": not traces,
            "colorbar": {
                "title": {"text": "score"},
                "orientation": "h",
                "y": 1,
                "yanchor": "bottom",
                "thickness": 12,
            },
        }
        z = [0.01] * len(rows)
        shown = {"mode": "markers", "marker": marker, "text": texts, "hoverinfo": "text"}
        traces.append({"x": x, "y": y, "z": z, **shown, "name": f"{len(rows)} {state}"})
    return traces


def _best(prediction: Prediction) -> list[dict[str, Any]]:
    row = prediction.best
    if row is None:
        return []
    gap = np.full((1, 3), np.nan)  # ends a line
    path = np.concatenate([part for line in robot_lines(prediction, row) for part in (line, gap)])
    x, y, z = ([None if np.isnan(v) else round(float(v), 4) for v in column] for column in path.T)
    text = f"best, score {prediction.score[row]:.3f}"
    line = {"mode": "lines", "line": {"color": BEST.colour, "width": 8}, "connectgaps": False}
    return [{"x": x, "y": y, "z": z, **line, "name": text, "hoverinfo": "name"}]
