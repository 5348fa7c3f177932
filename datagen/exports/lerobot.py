"""Executed trials as a LeRobot data set, version 3.0: one episode per candidate whose plan was executed.

Trials are executed again and drawn. An episode is the execution that decided the label, at the trials'
control rate. Layout: huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from datagen.drawing.film import Film, View
from datagen.drawing.trial_picture import Retrial, try_again
from datagen.exports.export_run import ExportSource, Made, NewFile, Step, scene_key
from datagen.exports.mp4 import CODEC, PIXELS, Video
from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES, SceneRows
from datagen.schemas.run import Run
from datagen.schemas.run_records import MAX_FILE_BYTES
from datagen.train.reader import JOIN_FIELDS
from datagen.workers.geometry.transforms import inverse
from datagen.workers.robots import open_robot
from datagen.workers.scenes.reconstruct import reconstruct_candidates

_CHUNK = 1000  # files in a folder
_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_VIDEO, _SIZE_PX = "observation.images.exterior", (320, 240)
_EXECUTED = np.array([stage == "execute" for stage in OUTCOMES.values()])
_POSE = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]  # in the frame of the arm's mount
_SUMS: tuple[str, ...] = ("min", "max", "mean", "std", "count")
# Features of one value.
_DTYPES = {"next.done": "bool", "next.success": "bool", "timestamp": "float32"} | dict.fromkeys(
    ("frame_index", "episode_index", "index", "task_index"), "int64"
)
Array = np.ndarray[Any, Any]
Stats = Mapping[str, Array]


def steps(source: ExportSource) -> Sequence[Step]:
    """A file of frames and one of episodes for each scene, then the files that describe all."""
    for run in source.runs:
        if "attempts" not in {field.name for field in run.schema.sample_fields}:
            problem = f"{run.manifest.spec.label_source} labels have no executed trials"
            raise InputError(source.path, "--to lerobot", problem, "Name a run of sim labels")
    shards = [shard for group in source.shards([*JOIN_FIELDS, "object_name"]) for shard in group]
    names = (place.read([part.arrays["object_name"]])["object_name"][:, 0] for part, place in shards)
    tasks = sorted({_task(name) for each in names for name in each})
    positions = enumerate(range(source.first, source.past))
    scenes = [partial(_scene, source, tasks, number, position) for number, position in positions]
    return [*scenes, partial(_about, source, tasks)]


def _task(target: object) -> str:
    return f"Grasp the object {target} and lift it."


def _fps(run: Run) -> float:
    arm = run.manifest.spec.arm
    assert arm is not None and arm.trial is not None
    fps = round(1 / arm.trial.control_period_s, 6)
    return int(fps) if fps.is_integer() else fps


def _scene(
    source: ExportSource, tasks: Sequence[str], number: int, position: int, made: Made
) -> Iterator[NewFile]:
    ((run, rows),) = source.scenes(position, position + 1)
    task = _task(rows.record["object_name"][0])
    frames, episodes, fps, filmed = list[dict[str, Array]](), list[Any](), _fps(run), 0
    (number_of, start), (chunk, file) = made.sums("episodes", "frames"), divmod(number, _CHUNK)
    video, at = Video(_SIZE_PX, fps), {"chunk_index": chunk, "file_index": file}
    for row, again, film in _trials(source, run, rows):
        columns, view = _frames(again, fps), film.view(_SIZE_PX)
        length, episode = len(columns["action"]), number_of + len(episodes)
        columns |= {"index": np.arange(start, start + length), "episode_index": np.full(length, episode)}
        columns["task_index"] = np.full(length, tasks.index(task))
        stats = {name: _stats(values) for name, values in columns.items()}
        stats[_VIDEO] = _film(film, view, video)
        times = {"from_timestamp": filmed / fps, "to_timestamp": (filmed + length) / fps}
        episodes.append(
            {"episode_index": episode, "tasks": [task], "length": length, "dataset_from_index": start}
            | {f"{part}/{key}": v for part in ("data", "meta/episodes") for key, v in at.items()}
            | {f"videos/{_VIDEO}/{key}": v for key, v in (at | times).items()}
            | {"dataset_to_index": start + length, "outcome": again.trial.outcome}
            | {"scene_id": scene_key(run.manifest.spec_hash, int(rows.record["scene_index"]))}
            | {name: int(rows.samples[name][row]) for name in ("candidate_index", "label")}
            | {"camera_pose": _poses(inverse(again.T_world_base) @ view.T[None])[0].tolist()}
            | {"camera_focal_px": view.camera(1).fx_px}
            | {f"stats/{name}/{key}": v.tolist() for name, of in stats.items() for key, v in of.items()}
        )
        start, filmed = start + length, filmed + length
        frames.append(columns)
    if episodes:
        table = pa.table({name: _arrow([each[name] for each in frames]) for name in frames[0]})
        path, counts = _PATH.format(**at), {"episodes": len(episodes), "frames": len(table)}
        yield NewFile(f"data/{path}.parquet", _parquet(table))
        yield NewFile(f"videos/{_VIDEO}/{path}.mp4", video.finished())
        yield NewFile(f"meta/episodes/{path}.parquet", _parquet(pa.Table.from_pylist(episodes)), counts)


def _trials(source: ExportSource, run: Run, rows: SceneRows) -> Iterator[tuple[int, Retrial, Film]]:
    """The candidates of a scene whose plan was executed: row, repeated trial, and its poses to draw."""
    executed = np.flatnonzero(_EXECUTED[rows.samples["outcome"]]).tolist()
    if executed:
        scene = source.rebuilt(run, rows.record)
        candidates = reconstruct_candidates(rows.samples, scene)
        for row in executed:
            again = try_again(scene, candidates, row, run.manifest.spec)
            if again.result is not None and len(again.recording.time_s):
                yield row, again, again.film(scene, run.manifest.spec)


def _film(film: Film, view: View, video: Video) -> Stats:
    """Append each frame's picture; statistics (3, 1, 1) of every second row and column, as LeRobot's are."""
    parts: list[Stats] = []
    for row in range(len(film.recording.time_s)):
        video.add(picture := view.picture(film.stage(row), 1))
        parts.append(_stats(np.asarray(picture)[::2, ::2].reshape(-1, 3) / 255))
    joined = _joined_stats(parts)
    return {name: joined[name].reshape(3, 1, 1) for name in _SUMS[:4]} | {"count": np.array([len(parts)])}


def _frames(again: Retrial, fps: float) -> dict[str, Array]:
    """The features of an episode's frames, by name. The action is the next state: what was reached."""
    recording = again.recording
    state = np.column_stack([recording.q_rad, recording.opening_m]).astype(np.float32)
    target = _poses(inverse(again.T_world_base) @ recording.T_world_object[:, 0])
    frame = np.arange(len(state))
    return {
        "observation.state": state,
        "observation.environment_state": target.astype(np.float32),
        "action": np.concatenate([state[1:], state[-1:]]),
        "next.done": frame == frame[-1],
        "next.success": (frame == frame[-1]) & (again.trial.outcome == "success"),
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
    }


def _poses(T: Array) -> Array:
    """Poses (N, 4, 4) as rows (N, 7) of `_POSE`."""
    return np.column_stack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])


def _stats(values: Array) -> Stats:
    flat = values.astype(np.float64).reshape(len(values), -1)
    return {name: getattr(flat, name)(axis=0) for name in _SUMS[:4]} | {"count": np.array([len(flat)])}


def _joined_stats(parts: Sequence[Stats]) -> Stats:
    """The statistics of all values from those of their parts."""
    low, high, mean, std, count = (np.array([part[name] for part in parts], np.float64) for name in _SUMS)
    weight = (count / count.sum()).reshape(-1, *[1] * (mean.ndim - 1))
    middle = (weight * mean).sum(0)
    spread = np.sqrt((weight * (std**2 + (mean - middle) ** 2)).sum(0))
    return dict(zip(_SUMS, (low.min(0), high.max(0), middle, spread, count.sum(0)), strict=True))


def _arrow(parts: Sequence[Array]) -> Any:
    values = np.concatenate(parts)
    flat = pa.array(values.reshape(-1))
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _parquet(table: Any) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return sink.getvalue().to_pybytes()


def _about(source: ExportSource, tasks: Sequence[str], made: Made) -> Iterator[NewFile]:
    """`info.json`, `stats.json` and the table of tasks."""
    episodes, frames = made.sums("episodes", "frames")
    if not episodes:
        problem = "no trial was executed in these scenes"
        raise InputError(source.path, "--to lerobot", problem, "Give other --scenes")
    run, rows = next(source.scenes(source.first, source.first + 1))
    arm = run.manifest.spec.arm
    assert arm is not None
    size = (float(rows.samples[name][0]) for name in ("arm_reach_m", "base_height_m"))
    state = [*open_robot(arm.robot_key, *size).joint_names, "gripper_opening_m"]
    names = {"observation.state": state, "action": state, "observation.environment_state": _POSE}
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(of)], "names": of} for name, of in names.items()
    }
    features |= {name: {"dtype": of, "shape": [1], "names": None} for name, of in _DTYPES.items()}
    fps, sizes = _fps(run), dict(zip(("height", "width", "channels"), (*_SIZE_PX[::-1], 3), strict=True))
    features[_VIDEO] = {"dtype": "video", "shape": [*sizes.values()], "names": [*sizes]}
    video = sizes | {"codec": CODEC, "pix_fmt": PIXELS, "fps": fps, "is_depth_map": False}
    features[_VIDEO]["info"] = {"has_audio": False} | {f"video.{key}": video[key] for key in video}
    stats: dict[str, Stats] = {}
    for file in made.files:
        if file.path.startswith("meta/episodes/"):
            table = pq.read_table(pa.BufferReader(made.storage.get(file.path, MAX_FILE_BYTES)))
            for name in features:
                columns = zip(*(table[f"stats/{name}/{key}"].to_pylist() for key in _SUMS), strict=True)
                parts = [dict(zip(_SUMS, map(np.array, each), strict=True)) for each in columns]
                stats[name] = _joined_stats([*([stats[name]] if name in stats else []), *parts])
    info = {"codebase_version": "v3.0", "robot_type": arm.robot, "fps": fps, "chunks_size": _CHUNK}
    info |= {"total_episodes": episodes, "total_frames": frames, "total_tasks": len(tasks)}
    info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "features": features}
    info |= {"splits": {"train": f"0:{episodes}"}, "data_path": f"data/{_PATH}.parquet"}
    info["video_path"] = f"videos/{{video_key}}/{_PATH}.mp4"
    info |= {key: source.about[key] for key in ("license", "acknowledgement")}
    yield NewFile("meta/info.json", json.dumps(info, indent=1).encode())
    plain = {name: {key: value.tolist() for key, value in of.items()} for name, of in stats.items()}
    yield NewFile("meta/stats.json", json.dumps(plain, indent=1).encode())
    # The tasks are the index of a pandas table.
    types = {"task": ("unicode", "object"), "task_index": ("int64", "int64")}
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, (kind, dtype) in types.items()
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
    table = pa.table({"task_index": np.arange(len(tasks)), "task": list(tasks)})
    about = table.replace_schema_metadata({"pandas": json.dumps(index)})
    yield NewFile("meta/tasks.parquet", _parquet(about))
