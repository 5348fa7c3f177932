"""Hands from files of the user's: fingers, pads and openings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.specification import TrialParams
from datagen.workers.grasps.search import hand_poses_of
from datagen.workers.robots import open_robot, robot_source
from datagen.workers.robots.assembly import assemble
from tests.sim_extra import needs_robots
from tests.workers.robots.conftest import LINKS, Made
from tests.workers.worlds import box_model

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


def test_pads_are_whole_faces_of_fingers_that_touch_with_an_edge(make: Made) -> None:
    # From 0.15 rad on, the fingers diverge: of 12 cm the outer half counts, which moves apart enough.
    gripper = open_robot(make(more="[hand.range]\nopen = [0.15, 0.6]\n"), None, 0.85).gripper
    assert gripper.pad_size_m[1] == pytest.approx(0.06, abs=0.005)


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
