"""`datagen replay`: make a scene again and compare it stage by stage, or run one shard for a debugger."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from datagen.configuration.specify import refuse_missing_packages
from datagen.console.options import AS_FOUND, AsJson, RunPath, Sources, Whole, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.display.progress import Step, steps
from datagen.drawing.replay_picture import draw_replay
from datagen.drawing.scene_picture import Shown
from datagen.regeneration.scenes import (
    OpenedSources,
    chosen_rows,
    open_replayer,
    open_sources,
    what_differs_here,
)
from datagen.regeneration.single_shard import replay_shard
from datagen.regeneration.stage_comparison import RECOMPUTED, StageComparison, compare_stages
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.identity import sample_ids
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.scene_rows import read_scene
from datagen.workers.scenes.reconstruct import reconstruct_scene

_PREFIX_AT_LEAST = 6
_SHOWN = 5


def replay(
    run: RunPath,
    sample: Annotated[str | None, Parameter(name="SAMPLE_ID")] = None,
    /,
    *,
    scene: Whole | None = None,
    shard: Whole | None = None,
    out: Path | None = None,
    given: Sources = AS_FOUND,
    json: AsJson = False,
) -> int:
    """Make a sample's scene again from its seeds and compare it with the stored one.

    Each stage is equal bit for bit, or the report counts the values that differ and gives the largest
    difference. The sample's label is also computed from the stored poses. Exit code 0 when all is equal, else
    1.

    With --shard, one shard, quarantined or not, runs in this process: an exception keeps its traceback, and a
    debugger stops where it is raised. No file is written.

    For example: datagen replay runs/first --scene 0 --out replay.png

    Args:
        sample: sample_id, 32 hexadecimal digits, or its first ones if unique.
        scene: Index of a scene, instead of a sample id.
        shard: Index of a shard to run in this process, for a debugger.
        out: Picture to write, FILE.png: the stored and the replayed scene.
    """
    if sum(given is not None for given in (sample, scene, shard)) != 1:
        problem = "is one of three ways to choose what to replay"
        raise InputError("datagen replay", "SAMPLE_ID", problem, "Give a sample id, --scene or --shard")
    if out is not None:
        refuse_output(out, "--out", ".png")
    runs = open_runs(run)
    if sample is not None:
        shards = sum(len(found.committed()) for found in runs)
        with steps("shards searched", shards, json) as step:
            found, index, row = find_sample(runs, sample, step)
    else:
        found, index, row = _only(run, runs, "--scene" if shard is None else "--shard"), scene, None
    refuse_missing_packages(found.manifest.spec.label_source)
    if shard is not None:
        if out is not None:
            raise InputError("--out", str(out), "a shard has no picture", "Omit it, or give --scene")
        return replay_shard(run, found, shard, open_sources(found, given), json)
    assert index is not None
    stored = read_scene(found, index)
    return _compare(run, found, index, stored, row, open_sources(found, given, needs_scenes=False), out, json)


def find_sample(runs: list[Run], text: str, step: Step = lambda: None) -> tuple[Run, int, int]:
    """Return (run, scene, row in its scene) of the committed sample whose id begins with these digits.

    Ids are hashes of specification, scene and candidate: they are computed, and only the list of commits is
    read. `step` is called for every shard. InputError where no id or more than one matches.
    """
    searched = runs[0].storage.url if len(runs) == 1 else f"{len(runs)} merged runs"
    wanted = text.lower()
    if not re.fullmatch(f"[0-9a-f]{{{_PREFIX_AT_LEAST},32}}", wanted):
        problem = f"is not {_PREFIX_AT_LEAST} to 32 hexadecimal digits"
        raise InputError("SAMPLE_ID", text[:40], problem, "Give the first digits of a sample_id")
    whole = bytes.fromhex(wanted[: len(wanted) // 2 * 2])
    found: list[tuple[Run, int, int]] = []
    for run in runs:
        layout, n = run.layout, run.n
        for shard in sorted(run.committed()):
            scenes, samples = layout.rows_wanted(shard, n)
            first = shard * layout.scenes_per_shard
            for scene in range(first, first + scenes):
                count = min(
                    layout.candidates_per_scene, samples - (scene - first) * layout.candidates_per_scene
                )
                for row, sample_id in enumerate(_ids(run, scene, count)):
                    if sample_id.startswith(whole) and sample_id.hex().startswith(wanted):
                        found.append((run, scene, row))
            step()
            if len(found) > _SHOWN:
                break
    if not found:
        fix = "Give the id of a committed sample of this run"
        raise InputError("SAMPLE_ID", text, f"is not a sample of {searched}", fix)
    if len(found) > 1:
        shown = ", ".join(_ids(r, s, k + 1)[k].hex() for r, s, k in found[:_SHOWN])
        raise InputError(
            "SAMPLE_ID", text, f"matches several samples of {searched} ({shown})", "Give more digits"
        )
    return found[0]


def _ids(run: Run, scene: int, count: int) -> list[bytes]:
    ids = sample_ids(run.manifest.spec_hash, scene, np.arange(count, dtype=np.int32))
    return [row.tobytes() for row in ids]


def _only(path: str, runs: list[Run], option: str) -> Run:
    if len(runs) == 1:
        return runs[0]
    parts = ", ".join(run.storage.url for run in runs[:3])
    problem = f"each of the {len(runs)} merged runs has its own"
    raise InputError(path, option, problem, f"Give a sample id, or name a part: {parts}")


def _compare(
    path: str,
    run: Run,
    scene: int,
    stored: SceneRows,
    row: int | None,
    origin: OpenedSources,
    out: Path | None,
    json: bool,
) -> int:
    replayer = open_replayer(run, origin)
    shard = scene // run.layout.scenes_per_shard
    candidates = stored.samples["candidate_index"].tolist()
    sampled = (
        None
        if replayer.sampling_world is None
        else replayer.sample_again(int(stored.record["scene_index"]), candidates)
    )
    stages = [] if sampled is None else compare_stages(run.schema, stored, sampled)
    rows = range(len(stored.samples["label"])) if row is None else [row]
    kept = chosen_rows(stored, rows)
    recomputed = compare_stages(run.schema, kept, replayer.recompute(stored, rows), RECOMPUTED)
    equal = all(stage.equal for stage in (*stages, *recomputed))
    report: dict[str, Any] = {
        "run": run.storage.url,
        "scene": scene,
        "shard": shard,
        "sample": None if row is None else _sample_of(stored, row),
        "equal": equal,
        "drawn_again": sampled is not None,
        "stages": [_plain(stage) for stage in stages],
        "recomputed": [_plain(stage) for stage in recomputed],
        "differs_here": what_differs_here(run, shard),
        "picture": None if out is None else str(out),
    }
    if out is not None:
        before, again = (
            Shown(path, run.manifest.spec, rows, reconstruct_scene(replayer.world, rows.record))
            for rows in (stored, sampled or stored)
        )
        draw_replay(report, before, again, row, out)
    if json:
        print_json(report)
    else:
        _print(path, report)
    return 0 if equal else 1


def _sample_of(stored: SceneRows, row: int) -> dict[str, Any]:
    samples = stored.samples
    return {
        "id": samples["sample_id"][row].tobytes().hex(),
        "candidate": int(samples["candidate_index"][row]),
        "base_xy_m": [float(v) for v in samples["base_xy_m"][row]],
        "label": int(samples["label"][row]),
        "heuristic_score": float(samples["heuristic_score"][row]),
    }


def _plain(stage: StageComparison) -> dict[str, Any]:
    differences = [
        {"field": d.field, "differing": d.differing, "largest": d.largest, "unit": d.unit}
        for d in stage.differences
    ]
    return {"stage": stage.stage, "fields": stage.fields, "equal": stage.equal, "differences": differences}


def _words(stage: dict[str, Any]) -> str:
    if stage["equal"]:
        return "equal"
    return "; ".join(
        f"{d['field']} in {d['differing']}"
        + ("" if d["largest"] is None else f", by up to {d['largest']:.3g} {d['unit'].strip('1')}").rstrip()
        for d in stage["differences"]
    )


def _print(path: str, report: dict[str, Any]) -> None:
    sample = report["sample"]
    rows = [(s["stage"], f"{s['fields']} fields", _words(s)) for s in report["stages"]]
    if not report["drawn_again"]:
        rows.append(("draw", "-", "not sampled again: the run of --scenes-from does not exist any more"))
    rows += [
        (f"{s['stage']}, from stored poses", f"{s['fields']} fields", _words(s)) for s in report["recomputed"]
    ]
    name = f"scene {report['scene']} of {path}"
    if sample is not None:
        x, y = sample["base_xy_m"]
        name = f"sample {sample['id']}, candidate {sample['candidate']} of {name}, base ({x:.3f}, {y:.3f}) m"
    print_rows(name, rows, ("stage", "compared", "result"))
    end = [("result", "equal, bit for bit" if report["equal"] else "different")]
    if report["differs_here"]:
        end.append(("this machine differs", "; ".join(report["differs_here"])))
    if report["picture"]:
        end.append(("picture", report["picture"]))
    print_rows("", end)
