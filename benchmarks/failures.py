"""Pictures of trials that failed: one sheet an outcome, one row a trial, four near views from grasp to end.

    python -m benchmarks.failures OUT [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 300] [--most 20]
                                  [--outcomes slipped dropped missed] [--only SCENE:ROW ...]

Candidates in range are sampled as a run samples them. Those whose first try fails become OUT/OUTCOME.png.
`--only` tries these candidates alone. Prints one line a trial.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.options import scene_options
from datagen.configuration.specify import specify
from datagen.drawing.film import Film, Lens, told_moments
from datagen.drawing.posed_robot import robot_bodies
from datagen.schemas.cost import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.houses import open_houses
from datagen.workers.labels.arm_labelling import ArmInScene, CandidateTrial, arm_in_scene, try_candidate
from datagen.workers.objects import open_objects
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.scenes.scene import SettledScene
from datagen.workers.world import World, assemble_world

_VIEW_PX, _TEXT_PX, _COLOURS = (120, 90), 12, 48
_COLUMNS = 2  # of trials


def main() -> None:
    """Write the sheets."""
    parser = scene_options(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--most", type=int, default=20, help="trials of an outcome")
    parser.add_argument("--outcomes", nargs="+", default=["slipped", "dropped", "missed"])
    parser.add_argument("--only", nargs="+", default=[], metavar="SCENE:ROW")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    spec, world = in_range_world(options)
    rows: dict[int, list[int]] = defaultdict(list)
    for given in options.only:
        index, row = map(int, given.split(":"))
        rows[index].append(row)
    strips: dict[str, list[Image.Image]] = defaultdict(list)
    for index in sorted(rows) or range(options.scenes):
        scene, candidates = generate_scene(world, index, StageClock())
        at = arm_in_scene(scene, candidates, 0, spec, StageClock())
        for row in rows.get(index) or range(len(candidates)):
            trial = try_candidate(at, candidates, row, spec, record=True)
            outcome = trial.outcome
            if outcome not in options.outcomes or len(strips[outcome]) == options.most:
                continue
            result = trial.results[0]
            words = f"{index}:{row} {scene.models[0].name}"
            lift_cm, slip_mm = 100 * result.lift_m, 1000 * result.slip_m
            print(f"{outcome:8} {words:32} lift {lift_cm:5.1f} cm, slip {slip_mm:3.0f} mm")
            strips[outcome].append(strip(scene, at, trial, spec, words))
    for outcome, found in strips.items():
        sheet(found).save(options.out / f"{outcome}.png", optimize=True)


def in_range_world(options: argparse.Namespace) -> tuple[Specification, World]:
    """What a run of 15 candidates in range of one robot a scene is made from."""
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    fields = {
        "seed": options.seed,
        "candidates.per_scene": 15,
        "candidates.robots_per_scene": 1,
        "candidates.within": "in-range",
    }
    spec = specify("sim", houses, objects, fields, None)
    return spec, assemble_world(spec, houses, objects, options.houses, options.objects)


def strip(
    scene: SettledScene, at: ArmInScene, trial: CandidateTrial, spec: Specification, words: str
) -> Image.Image:
    """Four near views: the hand at the grasp, closed, in the middle of what follows, and at the end."""
    recording = trial.results[0].recording
    assert recording is not None
    bodies = robot_bodies(at.robot, spec.candidates.base_radius_m)
    told = told_moments(recording)
    film = Film(cast(Any, scene), bodies, trial.T_world_base[0], recording, told, _VIEW_PX, _VIEW_PX)
    phase, last = np.array(recording.phase), len(recording.phase) - 1
    grasp, closed = (int(np.flatnonzero(phase == name)[-1]) for name in ("approach", "close"))
    lens = Lens(film.shots[1], 2, outlined=False)
    (w, h), moments = _VIEW_PX, (grasp, closed, (closed + last) // 2, last)
    image = Image.new("RGB", (w * len(moments), h + _TEXT_PX + 3), "#ffffff")
    ImageDraw.Draw(image).text((2, 1), words, "#141414")
    for k, moment in enumerate(moments):
        image.paste(Image.fromarray(lens.picture(film.stage(moment))), (k * w, _TEXT_PX + 3))
    return image


def sheet(strips: list[Image.Image]) -> Image.Image:
    """The strips in columns, with few colours."""
    w, h = strips[0].size
    lines = -(-len(strips) // _COLUMNS)
    page = Image.new("RGB", (min(_COLUMNS, len(strips)) * (w + 6), lines * (h + 2)), "#ffffff")
    for k, image in enumerate(strips):
        page.paste(image, ((k // lines) * (w + 6), (k % lines) * (h + 2)))
    return page.quantize(_COLOURS, dither=Image.Dither.NONE)


if __name__ == "__main__":
    main()
