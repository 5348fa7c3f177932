"""Scenes as recordings of Rerun: house, objects, cloud, camera, candidates, and the best trial."""

# Where Rerun is not installed, which most environments lack, its types are unknown.
# pyright: reportMissingImports=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownParameterType=false, reportUnknownArgumentType=false

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator, Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import color_sequences
from rerun.chunk import Chunk, ChunkStore

from datagen.drawing.posed_robot import robot_bodies
from datagen.drawing.scene_picture import best_success
from datagen.exports.export_run import ExportSource, NewFile, Step, scene_key
from datagen.exports.glb import LABEL_RGB, arrows
from datagen.schemas.fields import SceneRows, facing_rad
from datagen.schemas.run import Run
from datagen.workers.geometry.mesh import F64, Mesh, concatenate
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_candidates

if TYPE_CHECKING:
    from datagen.drawing.trial_picture import Retrial

_POINT_M, _BASE_M = 0.005, 0.04
_ROOM_TYPES, _SEE_THROUGH = ("Wall", "Door"), (255, 255, 255, 40)
# Where the viewer stands, in the frame of the entity "focus": origin at the target's centre, x level
# towards the camera, z up.
_EYE_M = (1.6, -0.4, 0.9)
_ABOUT = "__properties"  # where Rerun keeps what it says of a recording
# Of a file of Rerun: bytes before the first message, and kinds of messages.
_HEADER_BYTES, _END, _STORE = 12, 0, 1


def steps(source: ExportSource) -> Sequence[Step]:
    """A recording for each scene."""
    return source.each_scene(lambda run, rows: [recording(source, run, rows)])


def recording(source: ExportSource, run: Run, rows: SceneRows) -> NewFile:
    """The recording of a scene. InputError without its houses and objects."""
    scene = source.rebuilt(run, rows.record)
    key = scene_key(run.manifest.spec_hash, scene.index)
    chunks = [_identified(chunk, f"{key} {k}") for k, chunk in enumerate(_chunks(run, rows, scene))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.rrd"
        ChunkStore.from_chunks(chunks).write_rrd(str(path), application_id="datagen", recording_id=key)
        return NewFile(f"{key}.rrd", _repeatable(path.read_bytes()))


def joined(recordings: Sequence[bytes]) -> bytes:
    """The messages of files that `recording` and `layout` make, with one header and one end."""
    end = struct.pack("<QQ", _END, 0)
    messages = (data[_HEADER_BYTES:].removesuffix(end) for data in recordings)
    return b"".join([recordings[0][:_HEADER_BYTES], *messages, end])


def layout(has_trials: bool) -> bytes:
    """A file of Rerun that has the viewer begin near the target, with curves of joints if `has_trials`.

    Its identifiers differ each time, so exports, which repeat their bytes, have none.
    """
    eye = rrb.EyeControls3D(position=_EYE_M, look_target=(0.0, 0.0, 0.0))
    view = rrb.Spatial3DView(name="scene", origin="focus", contents="/**", eye_controls=eye)
    curves = [rrb.TimeSeriesView(name="joints, rad or m", origin="joints")] if has_trials else []
    shown = rrb.Vertical(view, *curves, row_shares=[3, 1][: 1 + len(curves)])
    panels = [panel(state="collapsed") for panel in (rrb.SelectionPanel, rrb.TimePanel)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "layout.rbl"
        rrb.Blueprint(shown, *panels).save("datagen", str(path))
        return _repeatable(path.read_bytes())


def _chunks(run: Run, rows: SceneRows, scene: ReconstructedScene) -> Iterator[Chunk]:
    record, samples, camera = rows.record, rows.samples, scene.camera
    n, trial = int(record["n_points"]), _best_trial(run, rows, scene)
    yield _static("/", rr.ViewCoordinates, xyz=[rr.components.ViewCoordinates.RIGHT_HAND_Z_UP])
    yield _static(_ABOUT, rr.archetypes.RecordingInfo, name=[f"scene {scene.index}: {scene.models[0].name}"])
    bodies = scene.house.house.bodies
    for path, are_walls, more in (("house", False, {}), ("walls", True, {"albedo_factor": [_SEE_THROUGH]})):
        if meshes := [body.visual for body in bodies if (body.object_type in _ROOM_TYPES) == are_walls]:
            yield _mesh(path, concatenate(meshes), **more)
    for k, (model, T) in enumerate(zip(scene.models, scene.T_world_object, strict=True)):
        yield _mesh(f"objects/{k}", model.visual)
        if trial is None:  # a static pose would hide one over time
            yield _pose(f"objects/{k}", T)
    cloud_m = record["points_m"][:n].astype(np.float32) + scene.target_center_m
    radii = np.full(n, _POINT_M)
    yield _static("cloud", rr.Points3D, positions=cloud_m, colors=record["rgb"][:n], radii=radii)
    yield _pose("camera", camera.T_world_camera)
    towards_m = camera.T_world_camera[:2, 3] - scene.target_center_m[:2]
    x_m, y_m, z_m = scene.target_center_m.tolist()
    yield _pose("focus", yaw_pose(x_m, y_m, z_m, float(facing_rad(towards_m))))
    K = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    size = [[camera.width_px, camera.height_px]]
    yield _static("camera", rr.Pinhole, image_from_camera=[K], resolution=size)
    bases_m = np.column_stack([samples["base_xy_m"], np.zeros(len(samples["label"]))])
    colors = LABEL_RGB[samples["label"]]
    yield _static(
        "candidates", rr.Points3D, positions=bases_m, colors=colors, radii=np.full(len(colors), _BASE_M)
    )
    yield _mesh("headings", arrows(rows))
    if trial is not None:
        yield from _moving(run, trial)


def _best_trial(run: Run, rows: SceneRows, scene: ReconstructedScene) -> Retrial | None:
    """The best success of a scene of `sim` labels, executed again; None where there is none."""
    row = best_success(rows.samples) if "attempts" in rows.samples else None
    if row is None:
        return None
    from datagen.drawing.trial_picture import try_again  # needs the extra sim

    return try_again(scene, reconstruct_candidates(rows.samples, scene), row, run.manifest.spec)


def _moving(run: Run, again: Retrial) -> Iterator[Chunk]:
    """A trial on the timeline `trial`: the robot's bodies, the objects, and the joints as curves."""
    recording, robot = again.recording, again.robot
    bodies = robot_bodies(robot, float(run.manifest.spec.candidates.radius_of_base_m(robot.reach_m)))
    for k, rays in enumerate(bodies.rays):
        yield _mesh(f"robot/{k}", rays.mesh)
    moments = zip(recording.q_rad, recording.opening_m, strict=True)
    T_robot = np.stack([bodies.poses(again.T_world_base, q, float(opening)) for q, opening in moments])
    for name, T in (("robot", T_robot), ("objects", recording.T_world_object)):
        for k in range(T.shape[1]):
            yield _pose(f"{name}/{k}", T[:, k], recording.time_s)
    colors = np.array(color_sequences["tab10"])[: len(robot.joint_names)]
    yield _static("joints", rr.SeriesLines, names=robot.joint_names, colors=colors)
    joints = rr.Scalars.columns(scalars=recording.q_rad)
    yield Chunk.from_columns("joints", [rr.TimeColumn("trial", duration=recording.time_s)], joints)


def _mesh(path: str, mesh: Mesh, **more: Any) -> Chunk:
    """A mesh with a vertex for each corner of its faces, since colours are of faces."""
    corners_m = mesh.vertices_m[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(corners_m), dtype=np.uint32).reshape(-1, 3)
    rgb = np.repeat(mesh.face_rgb, 3, axis=0)
    shown = {"vertex_positions": corners_m, "triangle_indices": faces, "vertex_colors": rgb}
    return _static(path, rr.Mesh3D, **shown, **more)


def _pose(path: str, T: F64, time_s: F64 | None = None) -> Chunk:
    """A pose (4, 4) in the world, or at each time (T, 4, 4)."""
    poses = T if time_s is not None else T[None]
    times = [] if time_s is None else [rr.TimeColumn("trial", duration=time_s)]
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3])
    return Chunk.from_columns(path, times, columns)


def _static(path: str, archetype: Any, **components: Any) -> Chunk:
    columns = [
        column
        for name, values in components.items()
        for column in archetype.columns(**{name: values}).partition([len(values)])
    ]
    return Chunk.from_columns(path, [], columns)


def _identified(chunk: Chunk, name: str) -> Chunk:
    """The chunk with identifiers that follow from its name, in place of random ones."""
    batch, first = chunk.to_record_batch(), sha256(name.encode()).digest()[:12]
    rows = pa.array([first + row.to_bytes(4, "big") for row in range(batch.num_rows)], pa.binary(16))
    known = {**batch.schema.metadata, b"rerun:id": b"chunk_" + first.hex().encode() + b"0" * 8}
    again = pa.RecordBatch.from_arrays([rows, *batch.columns[1:]], schema=batch.schema.with_metadata(known))
    return Chunk.from_record_batch(again)[0]


def _repeatable(data: bytes) -> bytes:
    """A recording without what differs each time: the identifier of its first message, and its index.

    The index at the end only speeds up reading. A message has its kind, its size and its bytes.
    """
    made, at, kind = bytearray(data[:_HEADER_BYTES]), _HEADER_BYTES, -1
    while kind != _END:
        kind, size = struct.unpack_from("<QQ", data, at)
        body = data[at + 16 : at + 16 + size]
        at += 16 + size
        if kind == _STORE:  # two numbers of 8 bytes, each after its tag
            body = body[:3] + bytes(8) + body[11:12] + bytes(8) + body[20:]
        body = b"" if kind == _END else body
        made += struct.pack("<QQ", kind, len(body)) + body
    return bytes(made)
