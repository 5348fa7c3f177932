"""The scenes of a run that the page shows: the most unusual ones, with pictures where they can be drawn."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from datagen.console.options import AssetSources
from datagen.display.html_page import escape, html_facts
from datagen.html_report.measures import scene_measures
from datagen.html_report.outliers import FEWEST, Measure, Outlier, most_unusual
from datagen.html_report.part_columns import PartColumns
from datagen.html_report.report_paths import ReportedPart
from datagen.html_report.scene_view import VIEW_HELP, scene_view
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.workers.extras import missing_library

# Draws a scene's pictures, as addresses of images.
Painter = Callable[[SceneRows], tuple[str, str]]

_MOST_EACH = 3  # scenes for one measure


def unusual_scenes(
    columns: PartColumns, count: int, given: AssetSources, step: Callable[[], None]
) -> list[str]:
    """The section of a run's unusual scenes as HTML. `step` is called after each scene."""
    measures = scene_measures(columns)
    chosen = most_unusual(measures, count, max(_MOST_EACH, -(-count // len(measures))))
    if not chosen:
        return []
    painter, why = _painter(columns.part, given)
    body = [
        f"<p>{escape(_introduction(columns, len(chosen), len(measures)))}</p><p class=note>{VIEW_HELP}</p>"
    ]
    if why:
        body.append(f"<p class=note>{escape(f'Without pictures: {why}')}</p>")
    by_name = {measure.name: measure for measure in measures}
    for row, outlier in chosen:
        rows = columns.part.scene(int(columns.shard[row]), int(columns.row[row]))
        body.append(_scene(columns, rows, _reason(by_name[outlier.measure], outlier, columns), painter))
        step()
    return body


def _introduction(columns: PartColumns, count: int, measures: int) -> str:
    scenes = len(columns.shard)
    if scenes < FEWEST:
        return f"{count} of {scenes} scenes: too few to find unusual ones."
    return (
        f"The {count} most unusual of {scenes:,} scenes ({columns.sample_words}), by the largest "
        ""
        f"z-score of {measures} measures."
    )


def _reason(measure: Measure, outlier: Outlier, columns: PartColumns) -> str:
    if len(columns.shard) < FEWEST:
        return f"{measure.name} {measure.text(outlier.value)}"
    median = measure.text(measure.median)
    return f"{measure.name} {measure.text(outlier.value)}, median {median} (z {outlier.score:+.1f})"


def _scene(columns: PartColumns, rows: SceneRows, reason: str, painter: Painter | None) -> str:
    record, label = rows.record, rows.samples["label"]
    index = int(record["scene_index"])
    title = f"Scene {index}: {record['object_name'][0]} on {record['support_type']}, {record['room_type']}"
    facts = [
        ("unusual", reason),
        ("house", str(record["house_id"])),
        ("positive", f"{int(label.sum())} of {len(label)} base poses"),
    ]
    pictures = ""
    if painter is not None:
        try:
            names = ("RGB frame, target outlined", "the room from above with the base poses")
            pictures = "".join(
                f'<figure><img src="{address}" alt="{name}"></figure>'
                for address, name in zip(painter(rows), names, strict=True)
            )
        except InputError as error:
            facts.append(("picture", f"cannot be drawn: {error}"))
    view = scene_view(rows, f"{title}: cloud and base poses; arrow keys turn the view")
    return (
        f'<section class="scene"><h4>{escape(title)}</h4>{html_facts(facts)}'
        f'<div class="pictures">{view}{pictures}</div></section>'
    )


def _painter(part: ReportedPart, given: AssetSources) -> tuple[Painter | None, str]:
    """The painter of a part's scenes, or None and why houses and objects cannot be opened or drawn."""
    sources = part.run.manifest.sources if part.run is not None else {}
    houses = given.houses or sources.get("houses", "builtin")
    objects = given.objects or sources.get("objects", "builtin")
    try:
        # Of the extra labels, which the rest of the page does not need.
        from datagen.html_report.scene_pictures import scene_pictures
        from datagen.workers.world import open_world

        world = open_world(part.spec, houses, objects)
    except InputError as error:
        return None, str(error)
    except ImportError as error:
        if (missing := missing_library(error)) is None:
            raise
        return None, str(missing)
    return partial(scene_pictures, world, part.address, part.spec), ""
