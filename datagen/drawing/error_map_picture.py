"""A picture of the floor around the target: the errors of one label source against another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from datagen.display.styles import LABEL_STYLES, TARGET
from datagen.reports.agreement_tables import name_of, set_name
from datagen.reports.error_map import CELL_M, HALF_CELLS

MIN_COUNT = 5  # a share of fewer candidates is not drawn
_FEW, _NONE = "#b9b9b9", "#ececf1"
_RINGS_M = (0.5, 1.0)
_WIDTH_IN, _HEIGHT_IN = 4.4, 3.9


def draw_error_maps(pairs: Sequence[dict[str, Any]], out: Path) -> None:
    """Draw a row for each pair of `paired_runs.pairs`: false positives, false negatives, and counts.

    The frame is that of `target_frame.in_edge_frame`. Writes a .svg or .png file.
    """
    figure = Figure(figsize=(3 * _WIDTH_IN, _HEIGHT_IN * len(pairs) + 0.5), layout="constrained")
    panels = figure.subplots(len(pairs), 3, squeeze=False)
    for row, pair in zip(panels, pairs, strict=True):
        source, reference = (name_of(pair[side]) for side in ("said_by", "true_by"))
        if source == reference:
            source, reference = "the first", "the second"
        counts = _grid(pair["error_map"], "count")
        shown = np.where(counts >= MIN_COUNT, counts, np.nan)
        good, bad = LABEL_STYLES[1].colour, LABEL_STYLES[0].colour
        shares = {
            kind: 100 * _grid(pair["error_map"], kind) / shown
            for kind in ("false_positive", "false_negative")
        }
        # One scale for both kinds of error of a pair.
        highest = 10 * np.ceil(max(1, *(np.nan_to_num(share).max() for share in shares.values())) / 10)
        for axes, share, colour, only in (
            (row[0], shares["false_positive"], bad, source),
            (row[1], shares["false_negative"], good, reference),
        ):
            title = f"only {only} calls it good"
            _draw_cells(axes, share, counts, colour, f"{title} (% of candidates)", float(highest))
        _draw_cells(row[2], np.where(counts > 0, counts, np.nan), counts, "#222222", "candidates", None)
        row[0].set_ylabel(f"{source} against {reference} ({set_name(pair['candidates'])})\ny [m]")
    words = f"Floor around the target, the nearest edge of its support below. Grey: under {MIN_COUNT} labels"
    figure.suptitle(f"{words}; pale: none", fontsize=11)
    with mpl.rc_context({"svg.hashsalt": "datagen", "svg.fonttype": "path"}):
        figure.savefig(
            out, dpi=110, metadata={"Date": None, "Creator": None} if out.suffix.lower() == ".svg" else {}
        )


def _grid(cells: dict[str, Any], name: str) -> npt.NDArray[np.float64]:
    """Counts (Y, X) on the whole map; 0 where no candidate is."""
    side, found = 2 * HALF_CELLS, np.zeros((2 * HALF_CELLS, 2 * HALF_CELLS))
    column, row = (
        np.floor(np.array(cells[axis]) / cells["cell_m"]).astype(int) + side // 2 for axis in ("x_m", "y_m")
    )
    found[row, column] = cells[name]
    return found


def _draw_cells(axes: Axes, values: Any, counts: Any, colour: str, title: str, highest: float | None) -> None:
    half_m = HALF_CELLS * CELL_M
    axes.set_facecolor(_NONE)
    extent = (-half_m, half_m, -half_m, half_m)
    few = np.where((counts > 0) & ~np.isfinite(values), 1.0, np.nan)
    grey = LinearSegmentedColormap.from_list("few", [_FEW, _FEW])
    axes.imshow(few, origin="lower", extent=extent, cmap=grey)
    scale = LinearSegmentedColormap.from_list("share", ["#ffffff", colour])
    drawn = axes.imshow(values, origin="lower", extent=extent, cmap=scale, vmin=0, vmax=highest)
    axes.figure.colorbar(drawn, ax=axes, shrink=0.75)
    for radius_m in _RINGS_M:
        axes.add_patch(Circle((0, 0), radius_m, fill=False, edgecolor="#888888", lw=0.7, ls=(0, (4, 3))))
        axes.annotate(f"{radius_m:g} m", (0, radius_m), ha="center", va="bottom", fontsize=7, color="#555555")
    axes.plot(0, 0, "o", ms=7, mfc=TARGET.colour, mec=TARGET.edge)
    axes.set(xlim=(-half_m, half_m), ylim=(-half_m, half_m), xlabel="x [m]")
    axes.set_title(title, fontsize=10)
