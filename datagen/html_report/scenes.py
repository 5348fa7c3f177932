"""Three scenes of a run: the frame with the target outlined, and the room with the base poses."""

from __future__ import annotations

from collections.abc import Iterator

from matplotlib.figure import Figure

from datagen.display.figures import draw_frame, new_picture, webp_of
from datagen.display.html_page import escape, html_picture
from datagen.drawing.floor_plan import draw_candidates, draw_plan
from datagen.drawing.scene_picture import Shown
from datagen.replaying import places_of
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Run
from datagen.workers.scenes.reconstruct import reconstruct_scene
from datagen.workers.world import World, open_world


def scene_sections(run: Run, scenes: list[SceneRows]) -> Iterator[str]:
    """Each scene as HTML. InputError where houses or objects cannot be opened or have changed."""
    spec = run.manifest.spec
    world = open_world(spec, *places_of(run))
    for rows in scenes:
        yield _scene(run, world, rows)


def _scene(run: Run, world: World, rows: SceneRows) -> str:
    shown = Shown(run.storage.url, run.manifest.spec, rows, reconstruct_scene(world, rows.record))
    good, whole = int(rows.samples["label"].sum()), len(rows.samples["label"])
    words = f"Scene {shown.recalled.index}: {shown.target}; {good} of {whole} base poses are good"
    frame = html_picture(webp_of(_frame(shown)), "the frame, with the target outlined in pink")
    plan = html_picture(webp_of(_plan(shown)), "the room from above, with the base poses")
    return f"<section><p>{escape(words)}</p>{frame}{plan}</section>"


def _frame(shown: Shown) -> Figure:
    figure = new_picture(4.2, 3.2)
    draw_frame(figure.subplots(), shown.frame.rgb, shown.frame.body == 1, "")
    return figure


def _plan(shown: Shown) -> Figure:
    figure = new_picture(4.2, 4.9)
    axes = figure.subplots()
    marks = draw_plan(axes, shown.recalled, shown.samples["base_xy_m"])
    legend = draw_candidates(axes, shown.samples)
    figure.legend(handles=[*legend, *marks], loc="outside lower left", frameon=False, fontsize=8)
    return figure
