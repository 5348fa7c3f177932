"""Robots from files of the user's: what is derived, what is refused, and what a digest depends on."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.specification import TrialParams
from datagen.workers.grasps.search import hand_poses_of
from datagen.workers.robots import (
    open_robot,
    remember,
    robot_digest,
    robot_limits,
    robot_source,
)
from datagen.workers.robots.assembly import assemble
from datagen.workers.robots.urdf import read_urdf
from tests.sim_extra import needs_robots
from tests.workers.worlds import box_model

# A 5-joint arm of plain solids on a box, with a hand of two fingers that pivot.
LINKS = {
    "base": '<box size="0.5 0.4 0.3"/>@0 0 0.15',
    "mast": '<cylinder radius="0.04" length="0.9"/>@0 0 0.45',
    "shoulder": '<sphere radius="0.05"/>@0 0 0',
    "upper": '<box size="0.35 0.06 0.06"/>@0.2 0 0',
    "lower": '<box size="0.3 0.05 0.05"/>@0.18 0 0',
    "wrist": '<cylinder radius="0.03" length="0.05"/>@0 0 0',
    "palm": '<box size="0.06 0.12 0.06"/>@0.06 0 0',
    "left": '<box size="0.12 0.01 0.02"/>@0.06 0 0',
    "right": '<box size="0.12 0.01 0.02"/>@0.06 0 0',
}
LIMIT = '<limit lower="{}" upper="{}" velocity="1" effort="10"/>'
JOINTS = [
    ("lift", "prismatic", "base", "mast", "0 0 0.05", "0 0 1", (0.0, 0.4), ""),
    ("pan", "continuous", "mast", "shoulder", "0.05 0 0.8", "0 0 1", None, ""),
    ("tilt", "revolute", "shoulder", "upper", "0.06 0 0", "0 1 0", (-1.5, 1.5), ""),
    ("elbow", "revolute", "upper", "lower", "0.42 0 0", "0 1 0", (-2.5, 2.5), ""),
    ("roll", "revolute", "lower", "wrist", "0.38 0 0", "1 0 0", (-3.0, 3.0), ""),
    ("hand", "fixed", "wrist", "palm", "0 0 0", "1 0 0", None, ""),
    ("open", "revolute", "palm", "left", "0.1 0.006 0", "0 0 1", (0.0, 0.6), ""),
    ("follow", "revolute", "palm", "right", "0.1 -0.006 0", "0 0 1", (-0.6, 0.0),
     '<mimic joint="open" multiplier="-1"/>'),
]  # fmt: skip
ENDS = 'base = "base"\ntip = "palm"'
TOML = 'urdf = "robot.urdf"\n\n[arm]\nbase = "base"\ntip = "palm"\n'


def urdf_text() -> str:
    links = []
    for name, shape in LINKS.items():
        solid, _, at = shape.partition("@")
        inside = f'<origin xyz="{at}"/><geometry>{solid}</geometry>'
        links.append(f'<link name="{name}"><collision>{inside}</collision></link>')
    joints = [
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/><axis xyz="{axis}"/>{LIMIT.format(*limits) if limits else ""}{more}</joint>'
        for name, kind, parent, child, at, axis, limits, more in JOINTS
    ]
    return "<robot name='r'>" + "\n".join(links + joints) + "</robot>"


Made = Callable[..., str]


@pytest.fixture
def make(tmp_path: Path) -> Made:
    """Writes the robot's files, with a text of each replaced, and returns the path of its TOML file."""

    def write(
        keys: tuple[str, str] = ("", ""), urdf: tuple[str, str] = ("", ""), folder: str = "a", more: str = ""
    ) -> str:
        at = tmp_path / folder
        at.mkdir(exist_ok=True)
        assert keys[0] in TOML and urdf[0] in urdf_text()
        (at / "robot.toml").write_text((TOML.replace(*keys, 1) if keys[0] else TOML) + more)
        text = urdf_text()
        (at / "robot.urdf").write_text(text.replace(*urdf, 1) if urdf[0] else text)
        return str(at / "robot.toml")

    return write


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


def test_pads_are_whole_faces_of_fingers_that_touch_with_an_edge(make: Made) -> None:
    # From 0.15 rad on, the fingers diverge: of 12 cm the outer half counts, which moves apart enough.
    gripper = open_robot(make(more="[hand.range]\nopen = [0.15, 0.6]\n"), None, 0.85).gripper
    assert gripper.pad_size_m[1] == pytest.approx(0.06, abs=0.005)


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
def test_fingers_whose_carriages_overlap_are_refused_and_grip_with_their_tips(tmp_path: Path) -> None:
    file = tmp_path / "baxter.toml"
    urdf = "package:example-robot-data/robots/baxter_description/urdf/baxter.urdf"
    text = f'urdf = "{urdf}"\n[arm]\nbase = "base"\ntip = "left_gripper_base_link"\n'
    file.write_text(text)
    with pytest.raises(InputError, match=r"baxter\.toml: hand: its fingers overlap .* with arm\.ignore"):
        assemble(robot_source(str(file)), None)
    tips = tmp_path / "tips.toml"
    tips.write_text(text + 'ignore = ["l_gripper_l_finger", "l_gripper_r_finger"]\n')
    linkage = assemble(robot_source(str(tips)), None).hand.gripper.linkage
    assert linkage is not None  # boxes at 11.25 mm of 6.5 mm, that slide by 20.833 mm each
    np.testing.assert_allclose(linkage.opening_m[[0, -1]], (0.016, 0.016 + 2 * 0.020833), atol=1e-5)


@needs_robots
def test_fingers_that_swing_past_one_another_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "alex.toml"
    urdf = "package:example-robot-data/robots/alex_description/urdf/alex_sake_hands.urdf"
    file.write_text(f'urdf = "{urdf}"\n[arm]\nbase = "Torso"\ntip = "LeftSakePalmLink"\n')
    with pytest.raises(
        InputError, match=r"alex\.toml: hand: its fingers swing past one another.*hand\.fingers"
    ):
        assemble(robot_source(str(file)), None)


@needs_robots
def test_an_arm_is_checked_against_its_deck() -> None:
    robot = open_robot("ur5", None, 0.4)
    names = [robot.link_names[a] + " " + robot.link_names[b] for a, b in robot.self_pairs]
    assert "base_link forearm_link" in names  # touches in half of all poses
    # From a pose of the forearm level over the deck the elbow is lowered until it stands in it.
    q = np.array([0.0, -0.3, 0.0, 0.0, 0.0, 0.0])
    lowered = [bool(robot.collides_itself(q + [0.0, angle, 0.0, 0.0, 0.0, 0.0])) for angle in (0.0, 0.6)]
    assert lowered == [False, True]


HAND = "".join(
    f'<link name="{name}"><collision><geometry>{LINKS[name].partition("@")[0]}</geometry></collision></link>'
    for name in ("palm", "left", "right")
) + "".join(
    f'<joint name="{name}" type="prismatic"><parent link="palm"/><child link="{child}"/>'
    f'<origin xyz="0.1 {y} 0"/><axis xyz="0 {side} 0"/><limit velocity="1" effort="10"/></joint>'
    for name, child, y, side in (("pan", "left", 0.006, 1), ("elbow", "right", -0.006, -1))
)


@pytest.mark.parametrize(
    "tcp", ["", "pad_size_m = [0.02, 0.02]\ntcp.xyz_m = [0.1, 0, 0]\ntcp.approach = 'x'\n"]
)
def test_sliding_fingers_that_stand_apart_when_closed_open_by_what_lies_between_them(
    make: Made, tcp: str, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = HAND.replace("0.1 0.006 0", "0.1 0.015 0").replace("0.1 -0.006 0", "0.1 -0.015 0")
    ranges = "range = { pan = [0, 0.04], elbow = [0, 0.04] }\n"
    more = f'[hand]\nurdf = "hand.urdf"\npalm = "palm"\n{ranges}{tcp}'
    name = make(('tip = "palm"', 'tip = "wrist"'), more=more)
    Path(name).with_name("hand.urdf").write_text(f"<robot name='h'>{hand}</robot>")
    gripper = assemble(robot_source(name), None).hand.gripper  # fingers of 10 mm, their middles 30 mm apart
    assert gripper.max_opening_m == pytest.approx(0.1)
    assert gripper.linkage is not None and gripper.linkage.opening_m[0] == pytest.approx(0.02)
    assert cli.run(["robot", name]) == 0
    assert "palm and 2 sliding bodies" in capsys.readouterr().out


def test_a_hand_grasps_nothing_thinner_than_what_lies_between_its_closed_pads(make: Made) -> None:
    hand = HAND.replace("0.1 0.006 0", "0.1 0.035 0").replace("0.1 -0.006 0", "0.1 -0.035 0")
    ranges = "range = { pan = [0, 0.04], elbow = [0, 0.04] }\n"
    name = make(
        ('tip = "palm"', 'tip = "wrist"'), more=f'[hand]\nurdf = "hand.urdf"\npalm = "palm"\n{ranges}'
    )
    Path(name).with_name("hand.urdf").write_text(f"<robot name='h'>{hand}</robot>")
    gripper = assemble(robot_source(name), None).hand.gripper  # its pads stay 60 mm apart, and may give by 10
    assert gripper.least_width_m == pytest.approx(0.05)
    rng = np.random.default_rng(0)
    thin, wide = (hand_poses_of(box_model("box", (side_m,) * 3), gripper, rng) for side_m in (0.025, 0.055))
    assert len(thin.opening_m) == 0 and len(wide.opening_m) > 50


@pytest.mark.parametrize("given", ["", 'lower="0" upper="0.01" '])
def test_fingers_with_names_of_the_arm_move_in_physics_as_far_as_the_file_says(
    make: Made, given: str
) -> None:
    pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")
    from datagen.workers.trials.physics import TrialWorld
    from datagen.workers.trials.trial_scene import TrialScene, articulation_of

    ranges = "[hand.range]\npan = [0.0, 0.04]\nelbow = [0.0, 0.04]\n"
    name = make(
        ('tip = "palm"', 'tip = "wrist"'), more=f'[hand]\nurdf = "hand.urdf"\npalm = "palm"\n{ranges}'
    )
    hand = HAND.replace("0.1 0.006 0", "0.1 0.005 0").replace("0.1 -0.006 0", "0.1 -0.005 0")  # closed
    hand = hand.replace("<limit ", f"<limit {given}")
    Path(name).with_name("hand.urdf").write_text(f"<robot name='h'>{hand}</robot>")
    robot = open_robot(name, None, 0.85)
    assert robot.gripper.linkage is None
    none = np.zeros((0, 3))
    things = (), none, none, (), np.zeros(0), np.zeros((0, 4, 4))
    scene = TrialScene(robot, articulation_of(robot), TrialParams(), 0.3, *things)
    world = TrialWorld(scene, np.eye(4), 0.03, 0.6)
    q = np.array([0.1, 0.2, -0.3, 0.4, 0.5])
    world.place_arm(q, 0.03)
    np.testing.assert_allclose(world.joints, [*q, 0.015, 0.015], atol=1e-5)
    low, high = np.array([joint.get_limits()[0] for joint in world._joints]).T
    np.testing.assert_allclose(
        (low[-2:], high[-2:]), ([0, 0], [robot.gripper.max_opening_m / 2] * 2), atol=1e-6
    )


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


@pytest.mark.parametrize(
    ("keys", "urdf", "more", "said"),
    [
        (('tip = "palm"', ""), ("", ""), "", r"robot\.toml: arm\.tip: is missing"),
        (("urdf", "urfd"), ("", ""), "", r"robot\.toml: urdf: is missing|urfd: is no key"),
        (("", ""), ("", ""), "[arm2]\n", r"arm2: is no key"),
        (("[arm]", "[arm"), ("", ""), "", r"robot\.toml: is not TOML"),
        (('"robot.urdf"', '"gone.urdf"'), ("", ""), "", r"gone\.urdf: cannot be read"),
        (('"robot.urdf"', '"package:no_such_thing/a.urdf"'), ("", ""), "", r"no_such_thing is not installed"),
        (('"robot.urdf"', '"package:numpy/../a.urdf"'), ("", ""), "", r"leaves its package"),
        (('tip = "palm"', 'tip = "plam"'), ("", ""), "", r"tip: link plam is not .* Did you mean palm"),
        (('"palm"', '"base"'), ("", ""), "", r"arm\.tip: no joint moves between base and base"),
        ((ENDS, 'base = "palm"\ntip = "base"'), ("", ""), "", r"not below link palm"),
        (("", ""), ('type="continuous"', 'type="floating"'), "", r"joint pan: is floating"),
        (("", ""), (LIMIT.format(-1.5, 1.5), ""), "", r"tilt: has no limit"),
        (("", ""), (LIMIT.format(-1.5, 1.5), LIMIT.format(7, 8)), "", r"range 7.0 to 8.0 is empty within"),
        (("", ""), ('link name="left"', 'link name="upper"'), "", r"link upper: is the name of 2 links"),
        (("", ""), ('joint name="roll"', 'joint name="pan"'), "", r"joint pan: is the name of 2 joints"),
        (("", ""), ('box size="0.35 ', 'box size="0 '), "", r"upper collision: has no volume.*arm\.ignore"),
        (("", ""), ('box size="0.35 ', 'box size="-0.35 '), "", r"collision: its box has a negative size"),
        (("", ""), ('multiplier="-1"', 'multiplier="0"'), "", r"hand: .*middle of its TCP"),
        (("", ""), ("", ""), "[hand.range]\nopen = [0.0, 0.01]\n", r"opens by [0-9.]+ mm: the hand"),
        (("", ""), ("", ""), "[hand.range]\nopen = [0.6, 0.0]\n", r"hand: its fingers do not part between"),
        (("", ""), ("0.12 0.01 0.02", "0.12 0.3 0.02"), "", r"fingers overlap even when they are open"),
        (("", ""), ("", ""), '[hand]\nfingers = ["gone"]\n', r"joint gone: is missing"),
        (("", ""), ("", ""), "[hand.range]\nopen = [0.0, 0.5]\ngone = [0.0, 0.1]\n", r"gone: is missing"),
        (('tip = "palm"', 'tip = "palm"\nignore = ["left", "right"]'), ("", ""), "", r"palm has a shape"),
        (('tip = "palm"', 'tip = "palm"\nignore = ["left"]'), ("", ""), "", r"only one finger moves"),
        (("", ""), ("", ""), '[hand.tcp]\nlink = "wrist"\n', r"hand\.tcp\.link: link wrist is not fixed"),
        (("", ""), ("", ""), '[hand.tcp]\napproach = "y"\n', r"hand\.tcp: approach y and closing y"),
        (("", ""), ("", ""), "[base]\nheight_m = 0.6\n", r"base\.height_m: is 0\.6 m, .* 0\.850 m"),
        (("", ""), ("", ""), "[base]\nfootprint_m = [[1, 1], [-1, -1], [1, -1], [-1, 1]]\n", r"crosses"),
        (("", ""), ("", ""), "[base]\nfootprint_m = [[1, 1], [2, 1], [2, 2]]\n", r"does not hold the mount"),
        (("", ""), ("", ""), "[base]\nfootprint_m = [[1, 1], [2, 1]]\n", r"base\.footprint_m"),
        (("", ""), ("", ""), "[base]\nfootprint_m = [[-1, 0], [0, 0], [1, 0]]\n", r"has no area"),
        (("", ""), ("", ""), '[base]\npresents = "side"\n', r"side_deg need each"),
        (("", ""), ("", ""), "[base]\nside_deg = 30.0\n", r"side_deg need each"),
        (("", ""), ("", ""), '[base]\npresents = "side"\nside_deg = 190\n', r"base\.side_deg: .* 180"),
        (("", ""), ("", ""), "[base]\npedestal = true\nradius_m = 0.3\n", r"excludes"),
        (('"base"\n', '"base"\ntucked = [[0.0, 0.0]]\n'), ("", ""), "", r"arm\.tucked: has rows of 2"),
        (('"base"\n', '"base"\nignore = ["gone"]\n'), ("", ""), "", r"arm\.ignore: link gone"),
        (("", ""), ("", ""), '[hand]\npalm = "lower"\n', r"link lower: is not below link palm"),
        (("", ""), ("", ""), "[hand.range]\nfollow = [0.0, 0.1]\n", r"hand\.range: joint follow mimics open"),
        (("", ""), ("", ""), "[arm.held]\nfollow = 0.1\n", r"arm\.held: joint follow mimics open. Name open"),
        (("", ""), ("", ""), "[arm.held]\nlift = 9.0\n", r"held\.lift: is 9, outside the range 0 to 0\.4"),
        (("", ""), ("", ""), "[hand.range]\ntilt = [0.0, 0.1]\n", r"hand\.range: joint tilt does not open"),
        (("", ""), ("", ""), '[hand]\nfingers = ["open", "roll"]\n', r"fingers: joint roll does not open"),
        (("", ""), ("", ""), "[arm.cuts_m]\nnope = [0.1]\n", r"arm\.cuts_m: link nope is not in the URDF"),
        (('urdf =', 'reach_m = 0.5\nurdf ='), ("", ""), "", r"reach_m: is 0\.5 m, and the URDF's arm has"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_line_that_names_the_key(
    make: Made,
    keys: tuple[str, str],
    urdf: tuple[str, str],
    more: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = make(keys, urdf, more=more)
    with pytest.raises(InputError, match=said):
        open_robot(path, None, robot_limits(path).base_height_m[0])  # pyright: ignore[reportOptionalSubscript]
    assert cli.run(["robot", path]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.strip().splitlines()
    assert line.startswith("error: ")


def test_meshes_of_every_format_are_read_and_broken_ones_refused(make: Made, tmp_path: Path) -> None:
    import trimesh

    box = '<box size="0.35 0.06 0.06"/>'
    mesh = trimesh.creation.box((0.35, 0.06, 0.06))
    plain = open_robot(make(), None, 0.85)
    for ending in ("obj", "stl", "glb", "dae"):
        if ending == "dae":
            pytest.importorskip("collada")
        path = make(urdf=(box, f'<mesh filename="upper.{ending}"/>'), folder=ending)
        mesh.export(Path(path).with_name(f"upper.{ending}"))
        robot = open_robot(path, None, 0.85)
        part, wanted = robot.link_parts_m[3][0], plain.link_parts_m[3][0]
        np.testing.assert_allclose(np.sort(part, axis=0), np.sort(wanted, axis=0), atol=1e-6)
    path = make(urdf=(box, '<mesh filename="model://arm/upper.dae"/>'), folder="unit")  # as in Gazebo's files
    (tmp_path / "unit/arm").mkdir()
    mesh.apply_scale(100.0).export(tmp_path / "unit/arm/upper.dae")
    text = (tmp_path / "unit/arm/upper.dae").read_text().replace("<up_axis>", "<unit meter='0.01'/><up_axis>")
    (tmp_path / "unit/arm/upper.dae").write_text(text)
    part = open_robot(path, None, 0.85).link_parts_m[3][0]
    np.testing.assert_allclose(np.sort(part, axis=0), np.sort(plain.link_parts_m[3][0], axis=0), atol=1e-6)
    for name, content, said in (
        ("package://arm/gone.stl", None, r"arm/gone.stl: cannot be read.*package://NAME is a folder"),
        ("a.step", b"ISO", r"a.step: is not a mesh .*Convert it to OBJ, STL"),
        ("in_mm.stl", trimesh.creation.box((350.0, 60.0, 60.0)).export(file_type="stl"), "is 350 m large"),
        ("gone.stl", None, "gone.stl: cannot be read"),
        ("bad.dae", b"<COLLADA>", r"bad.dae: (is not a mesh|needs)"),
        ("bad.glb", b"glTF" + bytes(40), "bad.glb: is not a mesh"),
    ):
        path = make(urdf=(box, f'<mesh filename="{name}"/>'), folder="broken")
        if content is not None:
            Path(path).with_name(name).write_bytes(content)
        with pytest.raises(InputError, match=said):
            robot_limits(path)
        shutil.rmtree(tmp_path / "broken")
    path = make(urdf=(box, '<mesh filename="large.stl"/>'), folder="large")
    trimesh.creation.icosphere(subdivisions=8, radius=0.03).export(Path(path).with_name("large.stl"))
    with pytest.raises(InputError, match=r"large\.stl: has [0-9,]+ faces.*500,000"):
        robot_limits(path)


def test_meshes_of_the_hand_are_cut_and_cuts_beside_a_mesh_are_named(make: Made) -> None:
    import trimesh

    for folder, height_m, parts in (("a", 0.01, 2), ("b", 0.05, 0)):
        cuts = ('"palm"\n', f'"palm"\ncuts_m = {{ palm = [{height_m}] }}\n')
        shape = '<mesh filename="palm.stl" scale="0.001 0.001 0.001"/>'
        path = make(cuts, ('<box size="0.06 0.12 0.06"/>', shape), folder)
        trimesh.creation.box((60.0, 120.0, 60.0)).export(Path(path).with_name("palm.stl"))
        if parts:
            palm = assemble(robot_source(path), None).hand.bodies[0]
            assert sorted(float(np.ptp(part[:, 2])) for part in palm.parts_m) == pytest.approx([0.02, 0.04])
            continue
        with pytest.raises(
            InputError, match=r"palm\.stl: .*\(50\.0,\): it reaches from z = -30 to 30 in its"
        ):
            assemble(robot_source(path), None)


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
