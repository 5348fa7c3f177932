"""Executed trials as a LeRobot data set, version 3.0: one episode per candidate whose plan was executed.

Trials are executed again, which takes about as long as the labels did. An episode is the execution that
decided the label, at the trials' control rate. Layout: huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from datagen.drawing.trial_picture import Retrial, try_again
from datagen.exports.export_run import ExportSource, Made, NewFile, Step, scene_key
from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES, SceneRows
from datagen.schemas.run import Run
from datagen.schemas.run_records import MAX_FILE_BYTES
from datagen.train.reader import JOIN_FIELDS
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.scenes.reconstruct import reconstruct_candidates

_CHUNK = 1000
_DATA, _EPISODES = (
    "data/chunk-{0:03d}/file-{1:03d}.parquet",
    "meta/episodes/chunk-{0:03d}/file-{1:03d}.parquet",
)
_EXECUTED = [stage == "execute" for stage in OUTCOMES.values()]
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]  # of the target, in the frame of the arm's mount
Columns = dict[str, np.ndarray[Any, Any]]


def steps(source: ExportSource) -> Sequence[Step]:
    """A file of frames and one of episodes for each scene, then the files that describe all."""
    for run in source.runs:
        arm = run.manifest.spec.arm
        if arm is None or arm.trial is None:
            problem = f"{run.manifest.spec.label_source} labels have no executed trials"
            raise InputError(source.path, "--to lerobot", problem, "Name a run of sim labels")
    tasks = _tasks(source)
    scenes = range(source.first, source.past)
    return [
        *(partial(_scene, source, tasks, k, at) for k, at in enumerate(scenes)),
        partial(_about, source, tasks),
    ]


def _tasks(source: ExportSource) -> list[str]:
    """What is asked for in the scenes, sorted."""
    shards = [shard for group in source.shards([*JOIN_FIELDS, "object_name"]) for shard in group]
    targets = {
        str(n)
        for part, place in shards
        for n in place.read([part.arrays["object_name"]])["object_name"][:, 0]
    }
    return sorted(map(_task, targets))


def _task(target: str) -> str:
    return f"Grasp the object {target} and lift it."


def _scene(
    source: ExportSource, tasks: Sequence[str], number: int, position: int, made: Made
) -> Iterator[NewFile]:
    ((run, rows),) = source.scenes(position, position + 1)
    sums = {key: sum(file.counts.get(key, 0) for file in made.files) for key in ("episodes", "frames")}
    first_episode, first_frame, where = sums["episodes"], sums["frames"], divmod(number, _CHUNK)
    frames: list[Columns] = []
    episodes: list[dict[str, Any]] = []
    for row, again in _trials(source, run, rows):
        columns = _frames(again, round(1 / _period_s(run)))
        length, task = len(columns["action"]), _task(str(rows.record["object_name"][0]))
        columns["index"] = np.arange(first_frame, first_frame + length)
        columns["episode_index"] = np.full(length, first_episode + len(episodes))
        columns["task_index"] = np.full(length, tasks.index(task))
        episodes.append(
            {
                "episode_index": first_episode + len(episodes),
                "tasks": [task],
                "length": length,
                "data/chunk_index": where[0],
                "data/file_index": where[1],
                "dataset_from_index": first_frame,
                "dataset_to_index": first_frame + length,
                "meta/episodes/chunk_index": where[0],
                "meta/episodes/file_index": where[1],
                "scene_id": scene_key(run.manifest.spec_hash, int(rows.record["scene_index"])),
                "candidate_index": int(rows.samples["candidate_index"][row]),
                "outcome": again.trial.outcome,
                "label": int(rows.samples["label"][row]),
            }
            | {f"stats/{k}/{s}": v for k, a in columns.items() for s, v in _stats(a).items()}
        )
        first_frame += length
        frames.append(columns)
    if episodes:
        joined = {name: np.concatenate([each[name] for each in frames]) for name in frames[0]}
        yield NewFile(_DATA.format(*where), _parquet(pa.table({k: _arrow(v) for k, v in joined.items()})))
        counts = {"episodes": len(episodes), "frames": len(joined["index"])}
        yield NewFile(_EPISODES.format(*where), _parquet(pa.Table.from_pylist(episodes)), counts)


def _period_s(run: Run) -> float:
    arm = run.manifest.spec.arm
    assert arm is not None and arm.trial is not None
    return arm.trial.control_period_s


def _trials(source: ExportSource, run: Run, rows: SceneRows) -> Iterator[tuple[int, Retrial]]:
    """The candidates of a scene whose plan was executed: row and repeated trial."""
    executed = np.flatnonzero(np.array(_EXECUTED)[rows.samples["outcome"]])
    if not len(executed):
        return
    scene = source.rebuilt(run, rows.record)
    candidates = reconstruct_candidates(rows.samples, scene)
    for row in executed.tolist():
        again = try_again(scene, candidates, row, run.manifest.spec)
        if again.result is not None:
            yield row, again


def _frames(again: Retrial, fps: int) -> Columns:
    """The features of an episode's frames, by name. The action is the next state: what was reached."""
    recording, inverse_base = again.recording, inverse(again.T_world_base)
    state = np.column_stack([recording.q_rad, recording.opening_m]).astype(np.float32)
    poses: F64 = inverse_base @ recording.T_world_object[:, 0]
    target = np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    frame, last = np.arange(len(state)), np.arange(len(state)) == len(state) - 1
    return {
        "observation.state": state,
        "observation.environment_state": target.astype(np.float32),
        "action": np.concatenate([state[1:], state[-1:]]),
        "next.done": last,
        "next.success": last & (again.trial.outcome == "success"),
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
    }


def _stats(values: np.ndarray[Any, Any]) -> dict[str, list[float]]:
    flat = values.astype(np.float64).reshape(len(values), -1)
    found = {name: getattr(flat, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return {**found, "count": [len(flat)]}


def _all_stats(episodes: pa.Table, features: Iterable[str]) -> dict[str, dict[str, list[float]]]:
    """The statistics of all frames from those of the episodes."""
    found: dict[str, dict[str, list[float]]] = {}
    for feature in features:
        low, high, mean, std, count = (
            np.array(episodes[f"stats/{feature}/{name}"].to_pylist(), np.float64)
            for name in ("min", "max", "mean", "std", "count")
        )
        weight = count / count.sum()
        middle = (weight * mean).sum(0)
        spread = np.sqrt((weight * (std**2 + (mean - middle) ** 2)).sum(0))
        values = {"min": low.min(0), "max": high.max(0), "mean": middle, "std": spread, "count": count.sum(0)}
        found[feature] = {name: value.tolist() for name, value in values.items()}
    return found


def _arrow(values: np.ndarray[Any, Any]) -> Any:
    flat = pa.array(values.reshape(-1))
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return sink.getvalue().to_pybytes()


def _about(source: ExportSource, tasks: Sequence[str], made: Made) -> Iterator[NewFile]:
    """`info.json`, `stats.json` and the table of tasks."""
    total = {key: sum(file.counts.get(key, 0) for file in made.files) for key in ("episodes", "frames")}
    if not total["episodes"]:
        raise InputError(
            source.path, "--to lerobot", "no trial was executed in these scenes", "Give other --scenes"
        )
    run = source.runs[0]
    spec, fps = run.manifest.spec, round(1 / _period_s(run))
    state = [*_joints(source, run), "gripper_opening_m"]
    names = {"observation.state": state, "action": state, "observation.environment_state": _POSE}
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(of)], "names": of} for name, of in names.items()
    }
    for name in ("next.done", "next.success", "timestamp", *_INDICES):
        dtype = "float32" if name == "timestamp" else "int64" if name in _INDICES else "bool"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    episodes = pa.concat_tables(
        pq.read_table(pa.BufferReader(made.storage.get(file.path, MAX_FILE_BYTES)))
        for file in made.files
        if file.path.startswith("meta/episodes/")
    )
    info = {
        "codebase_version": "v3.0",
        "robot_type": spec.arm.robot if spec.arm else None,
        "total_episodes": total["episodes"],
        "total_frames": total["frames"],
        "total_tasks": len(tasks),
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{total['episodes']}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
        **{key: source.about[key] for key in ("license", "acknowledgement")},
    }
    yield NewFile("meta/info.json", json.dumps(info, indent=4).encode())
    yield NewFile("meta/stats.json", json.dumps(_all_stats(episodes, features), indent=4).encode())
    # The tasks are the index of a pandas table.
    types = {"task": ("unicode", "object"), "task_index": ("int64", "int64")}
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, (kind, dtype) in types.items()
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": list(tasks)})
    yield NewFile(
        "meta/tasks.parquet", _parquet(table.replace_schema_metadata({"pandas": json.dumps(index)}))
    )


def _joints(source: ExportSource, run: Run) -> Sequence[str]:
    from datagen.workers.robots import open_robot

    _, rows = next(source.scenes(source.first, source.first + 1))
    spec = run.manifest.spec
    assert spec.arm is not None
    sizes = (float(rows.samples[name][0]) for name in ("arm_reach_m", "base_height_m"))
    return open_robot(spec.arm.robot_key, *sizes).joint_names
