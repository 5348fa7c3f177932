"""Broken URDFs and meshes are refused by file and field; sound ones keep their numbers."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datagen.schemas.errors import InputError
from datagen.workers.robots import robot_source
from datagen.workers.robots.assembly import assemble
from datagen.workers.robots.resources import package_folders
from datagen.workers.robots.robot_file import RobotSource
from datagen.workers.robots.urdf import read_urdf, rotation_rpy, rpy_rotation


def panda_folder() -> Path:
    return next(package_folders("mani_skill")) / "assets/robots/panda"


@pytest.fixture(scope="module")
def text() -> str:
    return (panda_folder() / "panda_v2.urdf").read_text()


@pytest.fixture
def build(tmp_path: Path, text: str) -> Callable[..., None]:
    """Assembles the Panda, or its scaled arm, from another text of its URDF."""
    (tmp_path / "franka_description").symlink_to(panda_folder() / "franka_description")
    urdf = tmp_path / "panda.urdf"

    def run(text: str, robot: str = "panda", reach_m: float | None = None) -> None:
        urdf.write_text(text)
        keys = robot_source(robot).keys.model_copy(update={"urdf": str(urdf)})
        assemble(RobotSource(tmp_path / "robot.toml", keys), reach_m)

    return run


@pytest.mark.parametrize(
    ("pattern", "other", "field", "said"),
    [
        ("</robot>", "", "", "not XML"),
        ('<?xml version="1.0" ?>', '<!DOCTYPE r [<!ENTITY a "b">]>', "", "document type"),
        ("</robot>", '<x:arm xmlns:x="http://www.ros.org/wiki/xacro"/></robot>', "", "is a xacro file"),
        ('"panda_joint8" type="fixed"', '"panda_joint8" type="prismatic"', "panda_joint8", "has no limit"),
        ('"panda_joint7" type="revolute"', '"panda_joint7" type="floating"', "panda_joint7", "is floating"),
        ('name="panda_joint2" type="revolute"', 'name="panda_joint2" type="ball"', "panda_joint2", "ball"),
        ('lower="-1.7628" upper="1.7628"', 'lower="nan" upper="1.7628"', "panda_joint2", "nan"),
        ('lower="-1.7628" upper="1.7628"', 'lower="1.7628" upper="-1.7628"', "panda_joint2", "empty"),
        ('lower="0.0" upper="0.04"', 'lower="0.0" upper="0.0001"', "hand", "cannot close on anything"),
        ('lower="0.0" upper="0.04"', 'lower="0.04" upper="0.04"', "hand.range.panda_finger_joint1", "empty"),
        ('<axis xyz="0 -1 0"/>', '<axis xyz="0 1 0"/>', "hand", "both sides"),
        ('<axis xyz="0 -1 0"/>', '<axis xyz="0 0 0"/>', "panda_finger_joint2", "no length"),
        ('<axis xyz="0 -1 0"/>', '<axis xyz="1e200 0 0"/>', "panda_finger_joint2", "beyond 1,000,000"),
        ('lower="0.0" upper="0.04"', 'lower="0.0" upper="1e300"', "panda_finger_joint1", "beyond 1,000,000"),
        ('<mimic joint', '<mimic multiplier="-1e300" joint', "panda_finger_joint2", "beyond 1,000,000"),
        ('<box size="22e-3 15e-3 20e-3"/>', '<box size="1e300 1 1"/>', "leftfinger", "beyond 1,000,000"),
        ('<parent link="panda_link2"/>', '<parent link="panda_linkx"/>', "panda_joint3", "panda_linkx"),
        ('<parent link="panda_link0"/>', '<parent link="panda_link7"/>', "panda_link", "loop"),
        ('<child link="panda_link3"/>', '<child link="panda_link2"/>', "joints", "two parents"),
        ('<mimic joint="panda_finger_joint1"', '<mimic joint="panda_finger_joint2"', "joint2", "mimics"),
        ('<mimic joint="panda_finger_joint1"', '<mimic joint="gone"', "gone", "is missing"),
        ("collision/link3.stl", "collision/gone.stl", "", "No such file"),
        ('<box size="22e-3 15e-3 20e-3"/>', "<torus/>", "panda_leftfinger", "has no box, cylinder"),
        ('<box size="22e-3 15e-3 20e-3"/>', '<cylinder radius="0.01"/>', "panda_leftfinger", "length"),
        ('<box size="22e-3 15e-3 20e-3"/>', '<box size="1e-12 1 1"/>', "panda_leftfinger", "no volume"),
        ('<box size="22e-3 15e-3 20e-3"/>', '<sphere radius="1e-30"/>', "panda_leftfinger", "no volume"),
        ('collision/link3.stl"', 'collision/link3.stl" scale="0 0 0"', "panda_link3", "no volume"),
        ('collision/link3.stl"', 'collision/link3.stl" scale="1 1e-30 1"', "panda_link3", "no volume"),
        ('<box size="22e-3 15e-3 20e-3"/>', '<sphere radius="0"/>', "panda_leftfinger", "no volume"),
        ('<box size="22e-3 15e-3 20e-3"/>', '<box size="1 2"/>', "panda_leftfinger", "3 finite numbers"),
        ('<mass value="4.970684"/>', '<mass value="-1"/>', "panda_link1", "negative"),
        ('<mass value="4.970684"/>', '<mass value="heavy"/>', "panda_link1", "heavy"),
        ("franka_description/meshes/collision/link3.stl", "x" * 10**6, "panda_link3", "1,000,000 char"),
        ('<link name="panda_link5">', "<link>", "link", "no name"),
        ('<link name="panda_link5">', f'<link name="{"x" * 10**6}">', "link xxx", "1,000,000 characters"),
        ('<parent link="panda_link2"/>', f'<parent link="{"x" * 10**6}"/>', "panda_joint3", "not exist"),
        ('<mimic joint="panda_finger_joint1"', f'<mimic joint="{"x" * 10**6}"', "joint xx", "is missing"),
        ('"panda_joint7" type="revolute"', f'"panda_joint7" type="{"x" * 10**6}"', "joint7", "not one of"),
        ('lower="-1.7628" upper="1.7628"', f'lower="{"9" * 10**6}"', "panda_joint2", "not 1 finite"),
        ('<mass value="4.970684"/>', f'<mass value="{"x" * 10**6}"/>', "panda_link1", "not 1 numbers"),
    ],
)  # fmt: skip
def test_broken_urdfs_are_refused_by_field(
    build: Callable[..., None], text: str, pattern: str, other: str, field: str, said: str
) -> None:
    assert pattern in text
    with pytest.raises(InputError) as refused:
        build(text.replace(pattern, other, 1))
    assert field in refused.value.field and said in refused.value.problem
    assert re.search(r"panda\.urdf|\.stl|robot\.toml", refused.value.place)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 600


def test_joints_that_mimic_one_another_do_not_multiply_without_end(tmp_path: Path) -> None:
    links = "".join(f'<link name="l{k}"/>' for k in range(5))
    joints = "".join(
        f'<joint name="j{k}" type="prismatic"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<limit lower="0" upper="1"/><mimic joint="j{k + 1}" multiplier="1e4"/></joint>'
        for k in range(4)
    ).replace('<mimic joint="j4" multiplier="1e4"/>', "")
    (tmp_path / "a.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    with pytest.raises(InputError, match=r"a\.urdf: joint j3: is mimicked 1e\+12 times"):
        read_urdf(tmp_path / "a.urdf")


def test_a_missing_or_empty_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.urdf"
    for text, problem in ((None, "cannot be read"), ("", "is not XML"), ("<sdf/>", "sdf: is not <robot>")):
        if text is not None:
            path.write_text(text)
        with pytest.raises(InputError, match=rf"a\.urdf: {problem}"):
            read_urdf(path)


@pytest.mark.parametrize("content", [b"", b"solid nothing\nendsolid", b"\x00" * 90, b"v 1 2"])
def test_a_broken_mesh_is_named(
    build: Callable[..., None], text: str, tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "bad.stl").write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.stl"):
        build(text.replace("franka_description/meshes/collision/link3.stl", "bad.stl", 1))


@given(st.lists(st.floats(-3.14, 3.14), min_size=3, max_size=3))
@example([0.4, np.pi / 2, -1.1])
@example([0.4, -np.pi / 2, -1.1])
def test_angles_and_rotations_agree(rpy: list[float]) -> None:
    R = rpy_rotation(np.array(rpy))
    np.testing.assert_allclose(R, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rpy_rotation(rotation_rpy(R)), R, atol=1e-8)


def test_an_arm_without_lengths_has_no_scale(build: Callable[..., None], text: str) -> None:
    build(text, "panda-scaled", 0.7)  # which is sound
    arm, hand = text.split('<link name="panda_hand">')
    arm = re.sub(
        r'(<joint name="panda_joint.*?<origin rpy="[^"]*" xyz=)"[^"]*"', r'\1"0 0 0"', arm, flags=re.S
    )
    with pytest.raises(InputError, match=r"panda\.urdf: joints: no scale gives a reach of 0\.7 m"):
        build(arm + '<link name="panda_hand">' + hand, "panda-scaled", 0.7)
