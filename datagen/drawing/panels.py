"""What pictures of scenes share: the sheet, the RGB frame, and facts in two columns of text."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from datagen.schemas.styles import TARGET
from datagen.workers.rendering.frame import Frame
from datagen.workers.scenes.recall import RecalledScene

Facts = Sequence[tuple[str, str]]

WIDTH_IN = 11.0  # at 800 pixels, as pages show pictures, text of 10 points is then 10 pixels high
_DPI = 120
_FACT_CHARACTERS, _HEAD_CHARACTERS = 66, 12


def new_sheet(title: str, height_in: float) -> Figure:
    """An empty figure of the common width that lays itself out."""
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13)
    return figure


def save_sheet(figure: Figure, out: Path) -> None:
    """Write the figure as a true-colour PNG, as small as it gets without loss."""
    with io.BytesIO() as drawn:
        figure.savefig(drawn, format="png")
        Image.open(drawn).convert("RGB").save(out, format="png", optimize=True)


def draw_frame(axes: Axes, frame: Frame, title: str = "RGB frame, target outlined") -> None:
    """Draw the RGB image with the target outlined."""
    axes.imshow(frame.rgb)
    if (target := frame.body == 1).any():
        for colour, width in ((TARGET.edge, 3.2), (TARGET.colour, 1.5)):
            axes.contour(target, levels=[0.5], colors=[colour], linewidths=width)
    axes.set_axis_off()
    axes.set_title(title)


def write_facts(axes: Sequence[Axes], columns: Sequence[Facts]) -> None:
    """Write (head, text) pairs, one column into each panel."""
    for ax, facts in zip(axes, columns, strict=True):
        ax.set_axis_off()
        indent = " " * _HEAD_CHARACTERS
        lines = [
            textwrap.fill(f"{head:<{_HEAD_CHARACTERS}}{text}", _FACT_CHARACTERS, subsequent_indent=indent)
            for head, text in facts
        ]
        ax.text(0, 1, "\n".join(lines), va="top", family="monospace", fontsize=9, transform=ax.transAxes)


def scene_facts(recalled: RecalledScene, record: Any) -> list[tuple[str, str]]:
    """House, room, support and objects of a scene."""
    height_m = float(np.asarray(record["T_world_support"])[2, 3])
    target = recalled.models[0]
    return [
        ("house", str(record["house_id"])),
        ("room", f"{record['room_type']} ({record['room_id']})"),
        ("support", f"{record['support_type']}, {height_m:.3f} m high"),
        ("target", f"{target.name}, {1000 * target.mass_kg:.0f} g"),
        ("clutter", ", ".join(m.name for m in recalled.models[1:]) or "none"),
    ]
