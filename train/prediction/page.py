"""A prediction as one HTML page that turns in a browser; it needs no other file and no network."""

from __future__ import annotations

from html import escape

import numpy as np
import plotly.graph_objects as go

from datagen.schemas.errors import printable
from datagen.schemas.specification import CandidateParams
from datagen.train.prediction.base_cells import STATES
from datagen.train.prediction.pictures import GOLD, shown_rows
from datagen.train.prediction.predict import Prediction
from datagen.train.prediction.prediction_report import told

_MOST_POINTS = 20_000
_SYMBOLS = {"clear": "square", "blocked": "x", "unseen": "square-open"}


def page_of(prediction: Prediction) -> str:
    """The cloud, every place with its score under the pointer, and the best pose in gold."""
    half_m = float(np.abs(prediction.places.offset_m).max()) + 0.5
    rows = shown_rows(prediction, _MOST_POINTS, half_m)
    figure = go.Figure(data=[_cloud(prediction, rows), *_places(prediction), *_best(prediction)])
    lines = "<br>".join(f"<b>{head}</b> {escape(printable(text))}" for head, text in told(prediction))
    figure.update_layout(
        title={"text": f"<span style='font-size:12px'>{lines}</span>", "y": 0.98, "yanchor": "top"},
        margin={"l": 0, "r": 0, "b": 0, "t": 40 + 15 * len(told(prediction))},
        scene={"aspectmode": "data", "xaxis_title": "x [m]", "yaxis_title": "y [m]", "zaxis_title": "z [m]"},
        legend={"x": 0.0, "y": 0.95},
    )
    return figure.to_html(include_plotlyjs=True, full_html=True, div_id="prediction")


def _cloud(prediction: Prediction, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> go.Scatter3d:
    points, rgb = prediction.seen.points_m[rows], prediction.seen.rgb[rows].copy()
    rgb[prediction.seen.on_target[rows]] = (214, 32, 78)
    colours = [f"rgb({r},{g},{b})" for r, g, b in rgb.tolist()]
    x, y, z = np.round(points.astype(np.float64), 3).T.tolist()
    marker = {"size": 1.8, "color": colours}
    return go.Scatter3d(
        x=x, y=y, z=z, mode="markers", marker=marker, hoverinfo="skip", name="cloud, target red"
    )


def _places(prediction: Prediction) -> list[go.Scatter3d]:
    traces: list[go.Scatter3d] = []
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
            "size": 3 if state == "blocked" else 6,
            "symbol": _SYMBOLS[state],
            "color": scores.tolist(),
            "colorscale": "RdYlGn",
            "cmin": 0,
            "cmax": 1,
            "showscale": not traces,
            "colorbar": {"title": "score", "len": 0.6},
        }
        z = [0.01] * len(rows)
        name = f"{len(rows)} {state}"
        traces.append(
            go.Scatter3d(
                x=x, y=y, z=z, mode="markers", marker=marker, text=texts, hoverinfo="text", name=name
            )
        )
    return traces


def _best(prediction: Prediction) -> list[go.Scatter3d]:
    row = prediction.best
    if row is None:
        return []
    (x, y), yaw = prediction.base_xy_m[row], float(prediction.yaw_rad[row])
    mount, top = prediction.robot.base_height_m, prediction.robot.camera_height_m
    angle = np.linspace(0, 2 * np.pi, 49) + yaw
    radius_m = CandidateParams().base_radius_m
    ring = np.column_stack([x + radius_m * np.cos(angle), y + radius_m * np.sin(angle)])
    tip = np.array([x + 0.35 * np.cos(yaw), y + 0.35 * np.sin(yaw), mount])
    gap = np.full((1, 3), np.nan)
    strokes = [
        np.column_stack([ring, np.full(49, 0.01)]),
        np.column_stack([ring, np.full(49, mount)]),
        np.array([[x, y, 0.01], [x, y, max(mount, top)]]),
        np.array([[x, y, mount], tip]),
    ]
    path = np.concatenate([part for stroke in strokes for part in (stroke, gap)])
    values = [[None if np.isnan(v) else round(float(v), 4) for v in column] for column in path.T]
    text = f"best, score {prediction.score[row]:.3f}"
    return [
        go.Scatter3d(
            x=values[0], y=values[1], z=values[2], mode="lines", line={"color": GOLD, "width": 8},
            name=text, hoverinfo="name", connectgaps=False,
        )
    ]  # fmt: skip
