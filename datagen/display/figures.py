"""Sheets of figures, frames with outlined targets, lines of facts."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from datagen.display.styles import TARGET

_WIDTH_IN = 11.0  # at 800 pixels, as pages show pictures, text of 10 points is then 10 pixels high
_DPI = 120
_LINE_IN, _TEXT_POINTS = 0.19, 68  # of facts: height of a line, and where texts begin


def new_sheet(title: str, height_in: float, width_in: float = _WIDTH_IN) -> Figure:
    """An empty figure, by default of the common width, with automatic layout."""
    figure = Figure(figsize=(width_in, height_in), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13)
    return figure


def save_sheet(figure: Figure, out: Path | IO[bytes], ending: str = ".png") -> None:
    """Write the figure as .png, .pdf or .svg, without its date and version."""
    metadata = {".png": "Software", ".pdf": "CreationDate", ".svg": "Date"}
    figure.savefig(out, format=ending[1:], metadata={metadata[ending]: None})


def draw_frame(axes: Axes, rgb: Any, target: Any, title: str = "RGB frame, target outlined") -> None:
    """Draw an RGB image (H, W, 3) with the outline of the target's pixels (H, W)."""
    axes.imshow(rgb)
    if target.any():
        for colour, width in ((TARGET.edge, 3.2), (TARGET.colour, 1.5)):
            axes.contour(target, levels=[0.5], colors=[colour], linewidths=width)
    axes.set_axis_off()
    axes.set_title(title)


def write_facts(axes: Axes, facts: Sequence[tuple[str, str]], columns: int = 68) -> float:
    """Write (head, text) pairs into a panel, in lines of `columns` letters; returns the height in inches."""
    axes.set_axis_off()
    line = 0
    for head, text in facts:
        for k, part in enumerate(textwrap.wrap(text, columns) or [""]):
            for x, words, colour in ((0, "" if k else head, "#555555"), (_TEXT_POINTS, part, "black")):
                at: dict[str, Any] = {"xytext": (x, -72 * _LINE_IN * line), "textcoords": "offset points"}
                drawn = axes.annotate(
                    words, (0, 1), xycoords="axes fraction", va="top", fontsize=9, color=colour, **at
                )
                drawn.set_in_layout(False)
            line += 1
    return _LINE_IN * (line + 2)
