"""Scenes of real runs, judged again from what is stored alone, by other code than made them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from datagen.schemas.fields import REDRAW_CAUSES
from datagen.schemas.run import Run
from datagen.schemas.specification import Specification
from datagen.workers.geometry.mesh import Mesh
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from datagen.workers.objects import open_objects
from datagen.workers.objects.model import ObjectModel
from tests.independent import camera_axes, pixel_counts, score
from tests.small_runs import CONFIG, PER_SCENE, arrays_of, make_small_run

SCENES = 8
WINDOW_PX = 64
PX_TOLERANCE = 3
TOUCH_M = 0.005
# The engine cooks hulls of its own and measures contacts before the last step.
SLACK_M = 0.002

Array = np.ndarray[Any, Any]
HalfSpaces = tuple[Array, Array]  # outward unit normals (F, 3) and offsets (F,): n x <= b inside


@dataclass(frozen=True, eq=False)
class Job:
    """A finished run and what it was made from."""

    spec: Specification
    folder: Path
    arrays: dict[str, Array]
    houses: Any
    objects: Any

    def scenes(self) -> Iterator[SceneOnDisk]:
        for row in range(SCENES):
            yield SceneOnDisk(self, row)


@dataclass(frozen=True, eq=False)
class SceneOnDisk:
    """One scene's rows, with its house and objects loaded anew."""

    job: Job
    row: int

    def record(self, name: str) -> Any:
        return self.job.arrays[name][self.row]

    def samples(self, name: str) -> Array:
        rows = self.job.arrays["sample_scene_index"] == self.record("scene_index")
        assert rows.sum() == PER_SCENE
        return self.job.arrays[name][rows]

    @cached_property
    def house(self) -> House:
        house = self.job.houses.load(str(self.record("house_id")))
        assert house.digest == self.record("house_digest")
        return house

    @cached_property
    def models(self) -> list[ObjectModel]:
        models = [self.job.objects.load(str(name)) for name in self.record("object_name")]
        assert [m.digest for m in models] == list(self.record("object_digest"))
        return models

    @cached_property
    def triangles(self) -> tuple[Array, Array]:
        """Target (F, 3, 3) and everything else, world."""
        poses = self.record("T_world_object")
        placed = [
            corners_of(m.visual) @ T[:3, :3].T + T[:3, 3] for m, T in zip(self.models, poses, strict=True)
        ]
        static = [corners_of(body.visual) for body in self.house.bodies]
        return placed[0], np.concatenate([*static, *placed[1:]])

    @cached_property
    def object_parts(self) -> list[list[Array]]:
        """World vertices of the convex parts of each object."""
        poses = self.record("T_world_object")
        return [
            [part.astype(np.float64) @ T[:3, :3].T + T[:3, 3] for part in m.convex_parts_m]
            for m, T in zip(self.models, poses, strict=True)
        ]

    @cached_property
    def house_parts(self) -> list[Array]:
        return [part.astype(np.float64) for body in self.house.bodies for part in body.convex_parts_m]


def corners_of(mesh: Mesh) -> Array:
    return mesh.vertices_m.astype(np.float64)[mesh.faces]


def half_spaces(vertices: Array) -> HalfSpaces:
    equations = ConvexHull(vertices).equations
    return equations[:, :3], -equations[:, 3]


def deepest_m(first: list[Array], second: list[Array]) -> float:
    """The largest overlap of a body of the first with one of the second; negative: the smallest gap."""
    boxes = [
        [np.array([ends(axis=0) for ends in (p.min, p.max)]) for p in bodies] for bodies in (first, second)
    ]
    (low_a, high_a), (low_b, high_b) = (np.array(ends).transpose(1, 0, 2) for ends in boxes)
    # Boxes that are apart by more than counts as touching: their gap is at least that.
    gaps = (np.maximum(low_a[:, None], low_b) - np.minimum(high_a[:, None], high_b)).max(axis=2)
    near = np.argwhere(gaps <= 2 * TOUCH_M)
    return max((overlap_m(first[i], second[j]) for i, j in near), default=-float(gaps.min()))


def overlap_m(a: Array, b: Array) -> float:
    """Width of the largest ball inside both convex bodies; negative: by how much they are apart."""
    (na, ba), (nb, bb) = half_spaces(a), half_spaces(b)
    normals, offsets = np.concatenate([na, nb]), np.concatenate([ba, bb])
    origin = (a.mean(0) + b.mean(0)) / 2  # small numbers for the solver
    found = linprog(
        [0, 0, 0, -1],
        A_ub=np.c_[normals, np.ones(len(normals))],
        b_ub=offsets - normals @ origin,
        bounds=[(None, None)] * 4,
    )
    assert found.status == 0, found.message
    return 2 * float(found.x[3])


def inside_outline(point: Array, outline: Array) -> bool:
    """Even-odd rule: how many edges a ray towards +x crosses."""
    crossings = 0
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if (y0 > point[1]) != (y1 > point[1]):
            crossings += point[0] < x0 + (point[1] - y0) / (y1 - y0) * (x1 - x0)
    return crossings % 2 == 1


@pytest.fixture(scope="module", params=["builtin", "real"])
def job(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Job:
    houses, objects = "builtin", "builtin"
    if request.param == "real":
        houses, objects = map(request.getfixturevalue, ("some_real_houses", "real_objects"))
    folder = tmp_path_factory.mktemp(request.param) / "run"
    config = CONFIG.replace("window_px = 24", f"window_px = {WINDOW_PX}")
    assert config != CONFIG
    more = ("--houses", houses, "--objects", objects, "--seed", "11")
    make_small_run(folder, SCENES * PER_SCENE, *more, config=config)
    spec = Run.open(folder).manifest.spec
    assert spec.visibility.window_px == WINDOW_PX
    return Job(spec, folder, arrays_of(folder), open_houses(houses), open_objects(objects))


def test_labels_follow_from_the_stored_poses(job: Job) -> None:
    exact, compared, tau = 0, 0, job.spec.heuristic.tau
    for scene in job.scenes():
        target, others = scene.triangles
        centre = scene.record("T_world_object")[0, :3, 3]
        radius = float(np.linalg.norm(target - centre, axis=2).max())
        assert scene.record("target_radius_m") == pytest.approx(radius, abs=1e-5)
        np.testing.assert_array_equal(scene.record("target_center_m"), centre)
        column = {
            name: scene.samples(name)
            for name in (
                "base_xy_m", "camera_height_m", "base_height_m", "distance_m", "mount_distance_m",
                "target_px", "visible_px", "visibility", "heuristic_score", "label",
            )
        }  # fmt: skip
        for k in range(0, PER_SCENE, 2):  # rasterising by numpy is slow
            x, y = (float(v) for v in column["base_xy_m"][k])
            d = float(np.hypot(x - centre[0], y - centre[1]))
            mount = float(
                np.linalg.norm([x - centre[0], y - centre[1], column["base_height_m"][k] - centre[2]])
            )
            assert column["distance_m"][k] == pytest.approx(d, abs=2e-6)
            assert column["mount_distance_m"][k] == pytest.approx(mount, abs=2e-6)

            eye = np.array([x, y, column["camera_height_m"][k]], np.float64)
            alone, seen = pixel_counts(target, others, centre, radius, eye, WINDOW_PX)
            stored_alone, stored_seen = int(column["target_px"][k]), int(column["visible_px"][k])
            assert abs(alone - stored_alone) <= PX_TOLERANCE
            assert abs(seen - stored_seen) <= PX_TOLERANCE
            exact += (alone, seen) == (stored_alone, stored_seen)
            compared += 1

            rho = stored_seen / max(stored_alone, 1)
            assert column["visibility"][k] == pytest.approx(rho, abs=1e-6)
            h = float(column["heuristic_score"][k])
            assert h == pytest.approx(score(d, rho), abs=2e-5)
            assert column["label"][k] == (np.float32(h) >= np.float32(tau))

            ours = score(d, seen / max(alone, 1))
            off = PX_TOLERANCE / max(alone, 1)
            wide = [score(d, min(max(seen / max(alone, 1) + s, 0.0), 1.0)) for s in (-off, off)]
            if not min(wide) <= tau <= max(wide):
                assert column["label"][k] == (ours >= tau)
    assert compared == SCENES * PER_SCENE // 2 and exact >= 0.85 * compared
    assert len(np.unique(job.arrays["label"])) == 2
    assert len(np.unique(job.arrays["visible_px"])) > 5


def test_things_rest_on_something(job: Job) -> None:
    for scene in job.scenes():
        T = scene.record("T_world_support")
        for k, parts in enumerate(scene.object_parts):
            lowest = min(part[:, 2].min() for part in parts)
            if abs(lowest - T[2, 3]) <= TOUCH_M:
                continue
            others = [p for j, other in enumerate(scene.object_parts) if j != k for p in other]
            assert deepest_m(parts, [*others, *scene.house_parts]) >= -TOUCH_M, (
                scene.row,
                scene.record("object_name")[k],
                lowest - T[2, 3],
            )


def test_nothing_sinks_into_another_thing(job: Job) -> None:
    limit_m = job.spec.settle.max_penetration_m + SLACK_M
    touching = 0
    for scene in job.scenes():
        assert scene.record("penetration_m") <= job.spec.settle.max_penetration_m
        bodies = [*scene.object_parts, scene.house_parts]
        for i, first in enumerate(bodies[:-1]):
            for other in bodies[i + 1 :]:
                depth = deepest_m(first, other)
                assert depth <= limit_m, (scene.row, i, depth)
                touching += depth > -TOUCH_M
    assert touching >= SCENES * len(scene.object_parts)  # every object touches at least its support


def test_the_target_is_in_the_frame_and_shows(job: Job) -> None:
    least = job.spec.observation.min_target_fraction
    for scene in job.scenes():
        T = scene.record("T_world_camera")
        target, others = scene.triangles
        eye, centre = T[:3, 3], scene.record("target_center_m")
        np.testing.assert_allclose(T[:3, :3].T, camera_axes(eye, centre), atol=1e-6)
        seen = (target.reshape(-1, 3) - eye) @ T[:3, :3]
        fx, fy, cx, cy = (float(v) for v in scene.record("intrinsics_px"))
        width, height = (int(v) for v in scene.record("image_size_px"))
        assert (seen[:, 2] > 0).all()
        u, v = fx * seen[:, 0] / seen[:, 2] + cx, fy * seen[:, 1] / seen[:, 2] + cy
        assert u.min() >= 0 and u.max() <= width and v.min() >= 0 and v.max() <= height

        radius = float(np.linalg.norm(target - centre, axis=2).max())
        alone, visible = pixel_counts(target, others, centre, radius, eye, 32)
        assert abs(visible / alone - scene.record("target_visible_fraction")) <= PX_TOLERANCE / alone
        assert visible >= least * alone - PX_TOLERANCE

        n, mask = int(scene.record("n_points")), scene.record("target_mask")
        points = scene.record("points_m").astype(np.float64)
        assert 0 < n <= len(points) and mask[:n].any() and not mask[n:].any()
        assert not points[n:].any()
        assert np.linalg.norm(points[:n], axis=1).max() <= job.spec.observation.crop_radius_m + 2e-3
        assert np.linalg.norm(points[:n][mask[:n]], axis=1).max() <= radius + 2e-3
        assert n >= 1 and abs(T[2, 3]) <= 3


def test_no_base_in_a_wall_or_furniture_or_outside_is_called_clear(job: Job) -> None:
    params, refused = job.spec.candidates, 0
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    disc = np.concatenate([[[0.0, 0.0]], 0.5 * ring, 0.98 * ring])
    for scene in job.scenes():
        # What a wheel rolls over is no obstacle; everything that rises higher is.
        spaces = [half_spaces(part) for part in scene.house_parts if part[:, 2].max() > 0.05]
        clear = scene.samples("base_is_clear")
        np.testing.assert_array_equal(clear, scene.samples("base_clearance_m") >= 0)
        for k in range(PER_SCENE):
            xy = scene.samples("base_xy_m")[k].astype(np.float64)
            mount, top = float(scene.samples("base_height_m")[k]), float(scene.samples("camera_height_m")[k])
            assert params.scaled_base
            # 0.25 m at the Panda's own reach, and as much narrower as the arm is shorter.
            radius_m = 0.25 * min(1.0, float(scene.samples("arm_reach_m")[k]) / 0.855)
            body = [np.c_[xy + radius_m * disc, np.full(len(disc), z)] for z in np.linspace(0.05, mount, 12)]
            mast = [
                np.c_[xy + params.mast_radius_m * disc, np.full(len(disc), z)]
                for z in np.linspace(mount, top, 8)
            ]
            points = np.concatenate(body + mast)
            hit = any((points @ n.T <= b - 1e-6).all(axis=1).any() for n, b in spaces)
            indoors = any(inside_outline(xy, room.polygon_m) for room in scene.house.rooms)
            assert not (clear[k] and (hit or not indoors)), (scene.row, k, hit, indoors)
            refused += hit or not indoors
    assert refused > 0 and job.arrays["base_is_clear"].any()


def test_ids_are_unique_and_redraws_add_up(job: Job) -> None:
    ids = job.arrays["sample_id"]
    assert len(np.unique(ids, axis=0)) == len(ids) == SCENES * PER_SCENE
    np.testing.assert_array_equal(job.arrays["retry"], job.arrays["redraws"].sum(axis=1))
    counted = dict.fromkeys(REDRAW_CAUSES, 0)
    for commit in Run.open(job.folder).commits():
        for cause, count in commit.redraws.items():
            counted[cause] += count
    assert list(counted.values()) == job.arrays["redraws"].sum(axis=0).tolist()
    np.testing.assert_array_equal(job.arrays["scene_index"], np.arange(SCENES))
    np.testing.assert_array_equal(job.arrays["candidate_index"], np.tile(np.arange(PER_SCENE), SCENES))
