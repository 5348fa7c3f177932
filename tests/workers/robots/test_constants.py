"""Constants of the robots' files against the URDFs and meshes that they cite; the URDF that is written."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.geometry.transforms import inverse, translation
from datagen.workers.robots import open_robot, reach, robot_limits, robot_source
from datagen.workers.robots.assembly import read_trees
from datagen.workers.robots.hulls import MAX_CORNERS, mesh_hulls, outer_hull, read_points
from datagen.workers.robots.reach import Chain, largest_reach_m
from datagen.workers.robots.resources import package_folders
from datagen.workers.robots.urdf import Inertial, UrdfTree, read_urdf, scaled_inertial
from examples.maniskill.robot_files import write_urdf


def tree_of(name: str) -> UrdfTree:
    return read_trees(robot_source(name))[0]


def folder() -> Path:
    return next(package_folders("mani_skill")) / "assets/robots"


def test_the_franka_hand() -> None:
    tree, robot = tree_of("panda"), open_robot("panda", None, 0.8)
    T_palm_tcp = robot.assembly.hand.T_palm_tcp
    np.testing.assert_allclose(T_palm_tcp, tree.joint("panda_hand_tcp_joint").T_parent_child)
    flange = tree.joint("panda_joint8").T_parent_child
    in_urdf = flange @ tree.joint("panda_hand_joint").T_parent_child
    np.testing.assert_allclose(robot.assembly.palm.T_parent_child, in_urdf, atol=1e-15)
    pad = tree.link("panda_leftfinger").collisions[3]
    assert pad.size_m is not None
    assert robot.gripper.pad_size_m == (pad.size_m[0], pad.size_m[2])
    centre = tree.joint("panda_finger_joint1").T_parent_child @ pad.T_link_shape
    assert abs((inverse(T_palm_tcp) @ centre)[2, 3]) < 0.0003  # as the file says
    gripper = robot.gripper
    assert gripper.max_opening_m == 0.08 and gripper.palm_depth_m == pytest.approx(0.0374, abs=2e-3)


def test_fetch() -> None:
    tree, limits, keys = tree_of("fetch"), robot_limits("fetch"), robot_source("fetch").keys
    torso, mount = tree.joint("torso_lift_joint"), tree.joint("shoulder_pan_joint")
    T_root_mount = torso.T_parent_child @ mount.T_parent_child
    assert limits.base_height_m is not None and limits.footprint_m is not None
    assert limits.base_height_m[0] == pytest.approx(T_root_mount[2, 3], abs=1e-3)
    points, _ = read_points(folder() / "fetch/fetch_description/meshes/base_link_collision.STL")
    outline = points[:, :2] - T_root_mount[:2, 3]
    assert np.hypot(*outline.T).max() <= limits.base_radius_m
    footprint = np.array(limits.footprint_m)
    assert inside_polygon(outline.astype(np.float64), footprint).all()
    assert ConvexHull(footprint).volume < 1.02 * ConvexHull(outline).volume  # the area of a planar hull
    finger, _ = read_points(folder() / "fetch/fetch_description/meshes/r_gripper_finger_link.STL")
    np.testing.assert_allclose(keys.hand.pad_size_m, np.ptp(finger, axis=0)[[2, 0]], atol=1e-3)
    # The wheels lie within the base's outline; their treads dip into the floor.
    base, whole = ConvexHull(points[:, :2]).equations, read_urdf(tree.path)
    for name in keys.arm.ignore:
        wheel = whole.link(name).collisions[0]
        assert wheel.mesh is not None and not tree.link(name).collisions
        corners = read_points(wheel.mesh)[0] + whole.joint_above(name).T_parent_child[:3, 3]
        assert (corners[:, :2] @ base[:, :2].T + base[:, 2]).max() < 0.0
        assert corners[:, 2].max() < points[:, 2].max()
        assert corners[:, 2].min() > -0.006 < 0.0


each_robot = pytest.mark.parametrize("name", ["panda", "xarm7", "fetch"])


@each_robot
def test_joints_are_those_of_the_urdf(name: str) -> None:
    heights = robot_limits(name).base_height_m or (0.8,)
    tree, robot = tree_of(name), open_robot(name, None, heights[0])
    for k, joint_name in enumerate(robot.joint_names):
        joint = tree.joint(joint_name)
        free = joint.kind == "continuous"
        assert robot.q_lower_rad[k] == (-np.pi if free else max(joint.lower, -2 * np.pi))
        assert robot.q_upper_rad[k] == (np.pi if free else min(joint.upper, 2 * np.pi))
        assert robot.speed_limit_radps[k] == joint.speed


@each_robot
def test_hulls_contain_their_meshes_closely(name: str) -> None:
    # docs/reference/robots.md states these.
    allowed: Mapping[str, float] = {"base_link": 0.009, "torso_lift_link": 0.005, "head_pan_link": 0.005}
    keys = robot_source(name).keys.arm
    for link in tree_of(name).links.values():
        for shape in link.collisions:
            if shape.mesh is None:
                continue
            cuts = keys.cuts_m.get(link.name, ())
            points, _ = read_points(shape.mesh)
            whole = ConvexHull(points).equations
            hulls = mesh_hulls(shape.mesh, cuts)
            inside = np.zeros(len(points), bool)
            for hull in hulls:
                faces = ConvexHull(hull).equations
                inside |= (points @ faces[:, :3].T + faces[:, 3]).max(axis=1) < 1e-7
                assert len(hull) <= MAX_CORNERS
                if not cuts:
                    excess_m = float((hull @ whole[:, :3].T + whole[:, 3]).max())  # at least so far outside
                    assert excess_m < allowed.get(link.name, 0.0041)
            assert inside.all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(4, 400), flat=st.floats(0.3, 1.0))
def test_outer_hulls_contain_any_points(seed: int, count: int, flat: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= (flat, 1.0, 2.0) / np.linalg.norm(points, axis=1, keepdims=True)  # all on the hull
    corners = outer_hull(points)
    assert len(corners) <= MAX_CORNERS
    faces = ConvexHull(corners).equations
    assert (points @ faces[:, :3].T + faces[:, 3]).max() < 1e-9
    assert ConvexHull(corners).volume < 1.35 * ConvexHull(points).volume


def test_the_wrist_extension_ends_where_it_should() -> None:
    """No tube from half a metre on; below it one that fills the gap between flange and hand."""
    rule = robot_source("panda-scaled").keys.scaled
    assert rule is not None
    for reach_m, length_m in ((0.3, 0.05), (0.4, 0.025), (0.5, 0.0), (0.9, 0.0)):
        robot = open_robot("panda-scaled", reach_m, 0.8)
        T = robot.T_base_link(robot.homes_rad[0])
        wrist, hand = robot.link_names.index("panda_link7"), robot.link_names.index("panda_hand")
        offset = (inverse(T[wrist]) @ T[hand])[2, 3]
        assert offset == pytest.approx(0.107 * robot.scale + length_m, abs=1e-12)
        assert len(robot.link_parts_m[wrist]) == (2 if length_m else 1)
        if length_m:
            tube = robot.link_parts_m[wrist][1]
            assert np.ptp(tube[:, 2]) == pytest.approx(length_m, abs=1e-6)
            assert np.hypot(tube[:, 0], tube[:, 1]).max() == pytest.approx(rule.tube_radius_m, rel=0.05)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 1.5))
def test_inertia_is_that_of_masses_kept_at_scaled_places(seed: int, scale: float) -> None:
    points = np.random.default_rng(seed).normal(size=(8, 3))

    def of(places: np.ndarray) -> Inertial:
        d = places - places.mean(axis=0)
        return Inertial(8.0, places.mean(axis=0), np.einsum("ni,ni->", d, d) * np.eye(3) - d.T @ d)

    scaled, expected = scaled_inertial(of(points), scale), of(points * scale)
    assert scaled.mass_kg == expected.mass_kg
    np.testing.assert_allclose(scaled.centre_m, expected.centre_m, atol=1e-12)
    np.testing.assert_allclose(scaled.inertia_kgm2, expected.inertia_kgm2, atol=1e-9)


def test_without_the_extension_the_hand_would_meet_the_forearm(tmp_path: Path) -> None:
    text = robot_source("panda-scaled").path.read_text()
    (tmp_path / "bare.toml").write_text(text.replace("tube_m = 0.05", "tube_m = 0.0"))
    pairs = {
        name: {(robot.link_names[a], robot.link_names[b]) for a, b in robot.self_pairs}
        for name in ("panda-scaled", "bare")
        for robot in [open_robot(name if name != "bare" else str(tmp_path / "bare.toml"), 0.3, 0.8)]
    }
    # They touch in most poses, and the rule that drops such pairs would hide it.
    assert ("panda_link5", "panda_hand") in pairs["panda-scaled"] - pairs["bare"]


@pytest.mark.parametrize("reach_m", [0.35, 0.8])
def test_parts_in_written_files_are_those_of_the_links(tmp_path: Path, reach_m: float) -> None:
    robot = open_robot("panda-scaled", reach_m, 0.8)
    tree = read_urdf(write_urdf(robot, tmp_path))
    assert len(tree.joints) == 10 and not any(link.visuals for link in tree.links.values())
    for name, parts in zip(robot.link_names, robot.link_parts_m, strict=True):
        shapes = tree.link(name).collisions
        assert len(shapes) == len(parts)
        for shape, part in zip(shapes, parts, strict=True):
            assert shape.mesh is not None
            mesh = trimesh.load_mesh(shape.mesh)
            assert mesh.is_watertight and mesh.volume > 0
            gaps = np.linalg.norm(np.asarray(mesh.vertices)[:, None] - part[None], axis=2)
            assert gaps.min(axis=1).max() < 1e-6
            np.testing.assert_allclose(mesh.bounds, [part.min(axis=0), part.max(axis=0)], atol=1e-6)


def test_a_stored_reach_is_the_computed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path))
    rng = np.random.default_rng(0)
    T = np.stack([translation(*xyz) for xyz in rng.uniform(-0.3, 0.3, (4, 3))])
    chain = Chain(T, np.eye(3)[[2, 1, 0, 1]], np.full(4, -2.0), np.full(4, 1.5), np.array([0.1, 0.0, 0.2]))
    computed = largest_reach_m(chain)
    reach._largest_reach_m.cache_clear()  # as another process
    monkeypatch.setattr(reach, "_ascended_m", None)
    assert largest_reach_m(chain) == computed
