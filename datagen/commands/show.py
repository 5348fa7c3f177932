"""`datagen show`: draw one scene of a run, or one trial in it."""

from __future__ import annotations

import re
from pathlib import Path

from datagen.configuration.robot_fields import refuse_missing_packages
from datagen.console.options import AS_FOUND, AssetSources, RunPath, Whole, refuse_output
from datagen.console.printing import print_rows
from datagen.drawing.scene_picture import Shown, draw_scene_picture
from datagen.replaying import places_of
from datagen.schemas.errors import InputError
from datagen.schemas.run import find_scene, open_runs
from datagen.schemas.shard_reading import read_scene
from datagen.workers.scenes.reconstruct import reconstruct_scene
from datagen.workers.world import open_world

_BEST = "best"


def show(
    run: RunPath, /, *, out: Path, scene: Whole = 0, trial: str | None = None, given: AssetSources = AS_FOUND
) -> int:
    """Draw a picture of one scene: the RGB frame, floor plans with the candidates, and numbers.

    With --trial, a candidate's trial is run again and drawn as a filmstrip, or animated in a .gif. Scenes are
    rendered again from the stored poses.

    For example: datagen show runs/first --scene 3 --out scene.png

    Args:
        out: Picture to write: FILE.png, or FILE.gif of a trial.
        scene: Index of the scene.
        trial: Show the trial of a candidate: its index, or best (plan, sim).
    """
    refuse_output(out, "--out", ".png", ".gif")
    is_trial = trial is not None or out.suffix.lower() == ".gif"
    candidate = _candidate(trial)
    opened, found = find_scene(open_runs(run), scene)
    spec = opened.manifest.spec
    if is_trial and spec.arm is None:
        problem = f"{spec.label_source} labels have no trials"
        fix = "Name a run of plan or sim labels, or give only --out FILE.png"
        raise InputError(run, "--trial" if trial is not None else "--out", problem, fix)
    refuse_missing_packages(spec.label_source)
    rows = read_scene(opened, found)
    world = open_world(spec, *places_of(opened, given))
    shown = Shown(run, spec, rows, reconstruct_scene(world, rows.record))
    if is_trial:
        # Imported here, so that scenes are drawn without the libraries for planning and trials.
        from datagen.drawing.trial_picture import draw_trial

        lines = draw_trial(shown, candidate, out)
    else:
        lines = draw_scene_picture(shown, out)
    print_rows(f"scene {scene} of {run}", [("target", shown.target), *lines, ("picture", str(out))])
    return 0


def _candidate(trial: str | None) -> int | None:
    """The candidate index that `--trial` names; None for the best success."""
    if trial is None or trial == _BEST:
        return None
    if not re.fullmatch(r"[+-]?[0-9]{1,30}", trial):
        fix = f"Give a candidate's index, or {_BEST}"
        raise InputError("--trial", trial[:40], "is not a whole number", fix)
    return int(trial)
