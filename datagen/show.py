"""`datagen show`: a picture that explains one scene of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from datagen.console import print_rows
from datagen.drawing.scene_picture import best_clear, draw_scene_picture
from datagen.whole_number import WHOLE_NUMBER
from schemas.errors import InputError
from schemas.identity import Stream, generator
from schemas.run import Run
from schemas.scene_rows import read_scene
from workers.scenes.draw import render_frame
from workers.scenes.recall import recall_scene
from workers.world import open_world


def show(
    run: Annotated[str, Parameter(help="The run's folder.")],
    *,
    out: Annotated[Path, Parameter(help="The picture to write, a .png file.")],
    scene: Annotated[int, WHOLE_NUMBER, Parameter(help="Index of the scene.")] = 0,
    houses: Annotated[str | None, Parameter(help="Houses, where they have moved since.")] = None,
    objects: Annotated[str | None, Parameter(help="Objects, where they have moved since.")] = None,
) -> int:
    """A picture of one scene: the RGB-D frame, floor plans with the candidates, the cloud, numbers.

    The frame is rendered again from the stored poses; nothing is drawn at random or simulated.
    """
    if out.suffix.lower() != ".png":
        raise InputError(out, "--out", "is not a .png file", "Give a name that ends in .png")
    if not out.parent.is_dir():
        raise InputError(out, "--out", "its folder does not exist", "Make the folder first")
    opened = Run.open(run)
    rows = read_scene(opened, scene)
    spec, sources = opened.manifest.spec, opened.manifest.sources
    world = open_world(
        spec, houses or sources.get("houses", "builtin"), objects or sources.get("objects", "builtin")
    )
    recalled = recall_scene(world, rows.record)
    noise_rng = generator(spec.seed, Stream.NOISE, scene, int(rows.record["retry"]))
    frame = render_frame(spec.observation, recalled.stage, recalled.camera, noise_rng)
    draw_scene_picture(f"{run}, scene {scene}", recalled, frame, rows.record, rows.samples, out)

    score, label = rows.samples["heuristic_score"], rows.samples["label"]
    best = best_clear(score, rows.samples["base_is_clear"])
    x_y = "" if best is None else ", ".join(f"{v:.3f}" for v in rows.samples["base_xy_m"][best])
    print_rows(
        f"scene {scene} of {run}",
        [
            (
                "target",
                f"{recalled.models[0].name} on {rows.record['support_type']}, {rows.record['room_type']}",
            ),
            ("positive", f"{int(label.sum())} of {len(label)} candidates"),
            ("best clear base", f"({x_y}) m, H = {score[best]:.3f}" if best is not None else "none is clear"),
            ("picture", str(out)),
        ],
    )
    return 0
