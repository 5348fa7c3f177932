"""Pictures of trials that failed: one sheet an outcome, one row a trial, four near views from grasp to end.

    python -m benchmarks.failures RUN OUT [--houses procthor:DIR] [--objects ycb:DIR] [--most 20]
                                  [--outcomes slipped dropped missed]

RUN is a run of `sim`. Its first failures of each outcome are executed again and become OUT/OUTCOME.png.
Prints one line a trial, with "differs" where it ends otherwise than stored.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.repeatability import stored_scenes
from datagen.drawing.film import Film, filmstrip_moments
from datagen.drawing.posed_robot import robot_bodies
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Specification
from datagen.workers.labels.arm_labelling import ArmInScene, CandidateTrial, arm_in_scene, try_candidate
from datagen.workers.scenes import SettledScene
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world

_VIEW_PX, _TEXT_PX, _COLOURS = (120, 72), 12, 48
_COLUMNS = 2  # side by side


def main() -> None:
    """Write the sheets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--most", type=int, default=20, help="trials of an outcome")
    parser.add_argument("--outcomes", nargs="+", default=["slipped", "dropped", "missed"])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    run = Run.open(options.run)
    spec = run.manifest.spec
    world = open_world(spec, options.houses, options.objects)
    names = list(OUTCOMES)
    strips: dict[str, list[Image.Image]] = defaultdict(list)
    for number, stored in stored_scenes(run, run.layout.scenes_per_shard * len(run.committed())):
        wanted = [o for o in options.outcomes if len(strips[o]) < options.most]
        stored_outcome = [names[code] for code in stored.samples["outcome"]]
        rows = [row for row, outcome in enumerate(stored_outcome) if outcome in wanted]
        if not wanted:
            break
        if not rows:
            continue
        scene = reconstruct_scene(world, stored.record)
        candidates = reconstruct_candidates(stored.samples, scene)
        for row in rows:
            outcome = stored_outcome[row]
            if len(strips[outcome]) == options.most:
                continue
            at = arm_in_scene(scene, candidates, row, spec, StageClock())
            trial = try_candidate(at, candidates, row, spec, record=True)
            result = trial.results[0]
            words = f"{number}:{row} {scene.models[0].name}"
            lift_cm, slip_mm = 100 * result.lift_m, 1000 * result.slip_m
            same = "" if trial.outcome == outcome else f", differs: {trial.outcome}"
            print(f"{outcome:8} {words:32} lift {lift_cm:5.1f} cm, slip {slip_mm:3.0f} mm{same}", flush=True)
            strips[outcome].append(strip(scene, at, trial, spec, words))
    for outcome, found in strips.items():
        if found:
            sheet(found).save(options.out / f"{outcome}.png", optimize=True)


def strip(
    scene: SettledScene, at: ArmInScene, trial: CandidateTrial, spec: Specification, words: str
) -> Image.Image:
    """Four near views: the hand at the grasp, closed, in the middle of what follows, and at the end."""
    recording = trial.results[0].recording
    assert recording is not None
    bodies = robot_bodies(at.robot, spec.candidates.base_radius_m)
    film = Film(cast(Any, scene), bodies, trial.T_world_base[0], recording, filmstrip_moments(recording))
    phase, last = np.array(recording.phase), len(recording.phase) - 1
    grasp, closed = (int(np.flatnonzero(phase == name)[-1]) for name in ("approach", "close"))
    near = film.views[1]
    (w, h), moments = _VIEW_PX, (grasp, closed, (closed + last) // 2, last)
    image = Image.new("RGB", (w * len(moments), h + _TEXT_PX + 3), "#ffffff")
    ImageDraw.Draw(image).text((2, 1), words, "#141414")
    for k, moment in enumerate(moments):
        view = near.picture(film.stage(moment), 1).resize(_VIEW_PX)
        image.paste(view, (k * w, _TEXT_PX + 3))
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
