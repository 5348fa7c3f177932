"""Robots from files of the user's: what is derived, and what a digest depends on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.workers.robots import (
    open_robot,
    remember,
    robot_digest,
    robot_limits,
    robot_source,
)
from datagen.workers.robots.urdf import read_urdf
from tests.sim_extra import needs_robots
from tests.workers.robots.conftest import LIMIT, Made


def test_everything_is_derived_from_a_file_of_five_lines(make: Made) -> None:
    name = make()
    limits = robot_limits(name)
    assert limits.base_height_m == (0.85, 0.85)
    assert limits.footprint_m is not None
    corners = np.array(limits.footprint_m)
    np.testing.assert_allclose(sorted(corners[:, 0]), [-0.3, -0.3, 0.2, 0.2], atol=0.001)
    robot = open_robot(name, None, 0.85)
    assert robot.name == "robot" and robot.joint_names == ("lift", "pan", "tilt", "elbow", "roll")
    # From the middle of the lift: links of 0.06, 0.42 and 0.38 m and the pads, plus half of the lift.
    T = robot.assembly.hand.T_palm_tcp
    np.testing.assert_allclose(T[:3, 2], (1, 0, 0), atol=1e-9)  # the approach
    assert abs(T[1, 1]) == pytest.approx(1.0) and T[1, 3] == pytest.approx(0.0, abs=1e-3)
    assert robot.gripper.linkage is not None
    opening = robot.gripper.linkage.opening_m
    assert (np.diff(opening) > 0).all() and opening[0] < 0.004 < 0.05 < opening[-1]
    depth = robot.gripper.linkage.depth_m
    assert depth[-1] < depth[0] - 0.01  # the tips move back as they open
    assert len(robot.homes_rad) >= 4 and not any(robot.collides_itself(q) for q in robot.homes_rad)


def test_a_mark_and_line_ends_of_windows_change_no_robot(make: Made) -> None:
    plain, other = make(), make(folder="b")
    for file in (Path(other), Path(other).with_name("robot.urdf")):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    assert robot_limits(other) == robot_limits(plain)


def test_python_and_predict_accept_a_file_wherever_a_name_is(make: Made) -> None:
    pytest.importorskip("torch")
    import datagen
    from datagen.train.prediction import read_footprint

    path = make()
    corners = datagen.robots[path].footprint_m
    assert corners is not None
    assert read_footprint(path).corners_m == read_footprint([list(corner) for corner in corners]).corners_m
    with pytest.raises(InputError, match=r"gone\.toml: cannot be read"):
        read_footprint("gone.toml")
    turning = make(folder="b", more='[base]\npresents = "turns"\n')
    assert read_footprint(turning).corners_m == () and datagen.robots[turning].yaw_rad == 0
    assert read_footprint(turning).radius_m == datagen.robots[turning].base_radius_m
    round_one = make(folder="c", more="[base]\nradius_m = 0.35\n")
    assert (read_footprint(round_one).corners_m, read_footprint(round_one).radius_m) == ((), 0.35)
    right = make(folder="d", more='[base]\npresents = "side"\nside_deg = -90\n')
    assert datagen.robots[right].yaw_rad == pytest.approx(np.pi / 2)
    assert read_footprint(right).corners_m == read_footprint(path).corners_m


def test_a_mimic_of_a_mimic_follows_the_driver(tmp_path: Path) -> None:
    chain = (
        '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/>{}</joint>'
    )
    mimic = '<mimic joint="{}" multiplier="{}" offset="{}"/>'
    mimics = ("", mimic.format("a", 2, 0.5), mimic.format("b", -3, 1))
    links = "".join(f"<link name='{k}'/>" for k in range(4))
    joints = "".join(chain.format("abc"[k], k, k + 1, mimics[k]) for k in range(3))
    file = tmp_path / "a.urdf"
    file.write_text(f"<robot>{links}{joints}</robot>")
    tree = read_urdf(file)
    joint, ratio, offset = tree.driver(tree.joint("c"))
    assert (joint.name, ratio, offset) == ("a", -6.0, -0.5)  # c = 1 - 3 b, b = 0.5 + 2 a


def test_a_mimic_joint_of_the_arm_has_the_range_that_its_driver_gives_it(make: Made) -> None:
    elbow = LIMIT.format(-2.5, 2.5)
    robot = open_robot(
        make(urdf=(elbow, f'{elbow}<mimic joint="tilt" multiplier="-1" offset="0.2"/>')), None, 0.85
    )
    assert robot.joint_names == ("lift", "pan", "tilt", "roll")
    joint = next(each for each in robot.assembly.arm if each.name == "elbow")
    assert (joint.lower, joint.upper) == pytest.approx((-1.3, 1.7))


def test_links_with_a_visual_alone_are_named_and_refused_where_no_other_moves(
    make: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    def seen_only(name: str, *links: str) -> str:
        file = Path(name).with_name("robot.urdf")
        for link in links:
            head, start, tail = file.read_text().partition(f'<link name="{link}"><')
            file.write_text(head + start + tail.replace("collision>", "visual>", 2))
        return name

    assert cli.run(["robot", seen_only(make(), "mast", "upper")]) == 0
    assert "mast, upper: without <collision>" in capsys.readouterr().out
    bare = seen_only(make(folder="b"), "mast", "shoulder", "upper", "lower", "wrist")
    with pytest.raises(InputError, match=r"robot\.toml: arm: no link that moves has a shape"):
        open_robot(bare, None, 0.85)


@needs_robots
def test_an_arm_is_checked_against_its_deck() -> None:
    robot = open_robot("ur5", None, 0.4)
    names = [robot.link_names[a] + " " + robot.link_names[b] for a, b in robot.self_pairs]
    assert "base_link forearm_link" in names  # touches in half of all poses
    # From a pose of the forearm level over the deck the elbow is lowered until it stands in it.
    q = np.array([0.0, -0.3, 0.0, 0.0, 0.0, 0.0])
    lowered = [bool(robot.collides_itself(q + [0.0, angle, 0.0, 0.0, 0.0, 0.0])) for angle in (0.0, 0.6)]
    assert lowered == [False, True]


def test_a_torso_is_held_where_the_file_says_so(make: Made) -> None:
    with pytest.raises(InputError, match=r"robot\.toml: arm: 3 joints move: pan, tilt, roll; 4 to 9 may"):
        robot_limits(make(more="[arm.held]\nlift = 0.3\nelbow = 0.1\n"))
    held = make(folder="b", more="[arm.held]\nlift = 0.3\n")
    robot = open_robot(held, None, robot_limits(held).base_height_m[0])  # pyright: ignore[reportOptionalSubscript]
    assert robot.joint_names == ("pan", "tilt", "elbow", "roll")
    assert robot.base_height_m == pytest.approx(1.15)


def test_a_digest_depends_on_content_and_not_on_the_place(make: Made) -> None:
    first, second = make(), make(folder="b")
    assert robot_digest(first) == robot_digest(second)
    turned = make(folder="c", urdf=('upper="1.5"', 'upper="1.4"'))
    named = make(folder="d", more='[hand]\nname = "other"\n')
    assert len({robot_digest(path) for path in (first, turned, named)}) == 3
    digest = robot_digest(first)
    assert digest is not None
    remember(second, "robot", digest)
    assert open_robot(f"robot@{digest}", None, 0.85).name == "robot"
    with pytest.raises(InputError, match="but the run was made with robot"):
        remember(turned, "robot", digest)
    renamed = Path(second).rename(Path(second).with_name("new.toml"))
    with pytest.raises(InputError, match=r"holds new .* made with robot .*under that name"):
        remember(str(renamed), "robot", digest)
    with pytest.raises(InputError, match="a file that was not named"):
        robot_source(f"robot@{'0' * 64}")


def test_a_missing_visual_mesh_and_a_link_without_length_do_not_block(make: Made) -> None:
    visual = '<visual><geometry><mesh filename="gone.dae"/></geometry></visual>'
    path = make(urdf=('<link name="upper">', f'<link name="upper">{visual}'))
    robot = open_robot(path, None, 0.85)
    assert [len(m.faces) > 0 for m in robot.link_meshes()] == [bool(p) for p in robot.link_parts_m]
    placeholder = '<visual><geometry><box size="0 0 0"/></geometry></visual>'  # as in Sawyer's URDF
    assert open_robot(make(urdf=('<link name="upper">', f'<link name="upper">{placeholder}')), None, 0.85)
    short = make(urdf=('"0.42 0 0"', '"0 0 0"'), folder="b")
    assert open_robot(short, None, 0.85).reach_m < robot.reach_m


@needs_robots
@pytest.mark.parametrize("name", ["stretch3", "tiago-pro", "ur5", "pr2", "fetch", "panda"])
def test_a_robot_is_printed_and_drawn(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    out = tmp_path / "robot.png"
    assert cli.run(["robot", name, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"robot {name}") and 15 <= len(printed.splitlines()) <= 32
    with Image.open(out) as image:
        pixels = np.asarray(image)
    assert pixels.std() > 10


@needs_robots
def test_robots_that_only_their_own_joints_can_describe() -> None:
    stretch = open_robot("stretch3", None, robot_limits("stretch3").base_height_m[0])  # pyright: ignore[reportOptionalSubscript]
    assert stretch.presents == "turns" and stretch.joint_names[0] == "base_turn"
    assert stretch.joint_names[2].count("+") == 3 and stretch.q_upper_rad[2] == pytest.approx(0.52)
    q = np.zeros(6)
    out = [stretch.T_base_tcp(np.array([0.0, 0.5, x, 0.0, 0.0, 0.0]))[:3, 3] for x in (0.0, 0.4)]
    np.testing.assert_allclose(out[1] - out[0], (0.0, -0.4, 0.0), atol=1e-5)  # to its right
    turned = stretch.T_base_tcp(q + (1.2, 0, 0, 0, 0, 0))[:3, 3]
    assert np.hypot(*turned[:2]) == pytest.approx(np.hypot(*stretch.T_base_tcp(q)[:2, 3]))
    # Its rubber cups are 4 cm wide; they touch with their rear edge, tilted by 10 degrees.
    assert stretch.gripper.pad_size_m == pytest.approx((0.04, 0.04 * np.cos(np.radians(10))), abs=0.006)
    tips_m = max(part[:, 2].max() for part in stretch.gripper.finger_parts_m[0])
    assert tips_m - stretch.gripper.pad_depth_m(np.zeros(1))[0] == pytest.approx(0.02, abs=0.003)
    pr2 = open_robot("pr2", None, robot_limits("pr2").base_height_m[0])  # pyright: ignore[reportOptionalSubscript]
    assert pr2.gripper.max_opening_m == pytest.approx(0.09, abs=0.003)  # as its URDF states
    tool = np.array([0.18, 0.0, 0.0])  # r_gripper_tool_frame
    assert np.linalg.norm(pr2.assembly.hand.T_palm_tcp[:3, 3] - tool) < 0.01
    tiago = open_robot("tiago-pro", None, robot_limits("tiago-pro").base_height_m[0])  # pyright: ignore[reportOptionalSubscript]
    assert tiago.gripper.linkage is not None and len(tiago.gripper.linkage.parts_m) == 7
