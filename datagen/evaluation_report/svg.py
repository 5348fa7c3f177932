"""Figures as inline SVG: no external file, the same bytes for the same numbers."""

from __future__ import annotations

import io

import matplotlib as mpl
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

LINES = ("--", "-.", ":")


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure with constrained layout."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def svg_of(figure: Figure, name: str) -> str:
    """The `<svg>` element; `name` makes its ids unique on the page."""
    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :]
