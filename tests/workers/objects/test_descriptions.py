"""Objects that MuJoCo models and SDF files describe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.workers.objects.folder import FolderObjects


def test_a_mujoco_model_is_read_with_includes_classes_and_solids(tmp_path: Path) -> None:
    home = tmp_path / "blocks"
    home.mkdir()
    (home / "defaults.xml").write_text(
        '<mujocoinclude><default><geom density="700"/><default class="small">'
        '<geom type="box" size=".02 .02 .02"/>'
        '<default class="ghost"><geom contype="0" conaffinity="0"/></default></default></default>'
        "</mujocoinclude>"
    )
    (home / "blocks.xml").write_text(
        '<mujoco><compiler angle="degree"/><include file="defaults.xml"/><worldbody>'
        '<geom type="plane" size="1 1 1"/><body childclass="small" euler="0 0 90"><freejoint/>'
        '<geom pos=".02 0 0"/><geom pos="-.02 0 0" rgba="0 0 1 1"/>'
        '<geom class="ghost" pos="0 0 .01" group="4"/>'
        "</body></worldbody></mujoco>"
    )
    (tmp_path / "ball.xml").write_text(
        '<mujoco><worldbody><body><geom size="0.03" mass="0.1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "can.sdf").write_text(
        "<sdf version='1.6'><model name='can'><link name='a'><drake:x/><collision name='c'>"
        "<pose>0 0 0 1.5708 0 0</pose>"
        "<geometry><cylinder><radius>0.03</radius><length>0.1</length></cylinder></geometry></collision></link>"
        "</model></sdf>"
    )
    source = FolderObjects(tmp_path)
    blocks, can = source.load("blocks"), source.load("can")
    np.testing.assert_allclose(blocks.size_m, (0.04, 0.08, 0.04), atol=1e-6)
    assert len(blocks.convex_parts_m) == 2 and blocks.mass_kg == pytest.approx(700 * 2 * 0.04**3, rel=1e-5)
    assert source.load("ball").mass_kg == 0.1
    np.testing.assert_allclose(can.size_m, (0.06, 0.1, 0.06), atol=1e-3)  # it lies, as the file has it


def _sdf_shape(solid: str, pose: str) -> str:
    shape = f"{pose}<geometry>{solid}</geometry>"
    return f"<visual name='v'>{shape}</visual><collision name='c'>{shape}</collision>"


_POST = _sdf_shape("<box><size>0.06 0.06 0.2</size></box>", "")
_BOARD = _sdf_shape("<box><size>0.2 0.06 0.02</size></box>", "")
_ABOVE = "<link name='b'><pose relative_to='{}'>0 0 {} 0 0 0</pose>" + _BOARD + "</link>"
_UPRIGHT = "<link name='a'><pose>0 0 0.1 0 0 0</pose>" + _POST + "</link>"
_FIXED = (
    "<joint name='j' type='fixed'><pose {}>0 0 0.1 0 0 0</pose><parent>a</parent><child>b</child></joint>"
)


@pytest.mark.parametrize(
    ("parts", "size_m"),
    [
        (
            "<link name='a'>"
            + _sdf_shape(
                "<box><size>0.2 0.06 0.1</size></box>", "<pose degrees='true'>0 0 0.05 0 0 90</pose>"
            )
            + "</link>",
            (0.06, 0.2, 0.1),
        ),
        (_UPRIGHT + _ABOVE.format("a", 0.11), (0.2, 0.06, 0.22)),
        # As `gz sdf -p` writes a URDF's joints.
        (_UPRIGHT + _FIXED.format("relative_to='a'") + _ABOVE.format("j", 0.01), (0.2, 0.06, 0.22)),
        (
            _UPRIGHT + "<frame name='f' attached_to='a'><pose>0 0 0.1 0 0 0</pose></frame>"
            "<link name='b'><pose relative_to='f'>0 0 0.01 0 0 0</pose>" + _BOARD + "</link>",
            (0.2, 0.06, 0.22),
        ),
        (
            "<link name='a'><pose>0 0 0.5 0 0 0</pose>"
            + _sdf_shape(
                "<box><size>0.06 0.06 0.2</size></box>", "<pose relative_to='__model__'>0 0 0.6 0 0 0</pose>"
            )
            + _sdf_shape("<box><size>0.2 0.06 0.02</size></box>", "<pose>0 0 0.21 0 0 0</pose>")
            + "</link>",
            (0.2, 0.06, 0.22),
        ),
        (
            "<link name='a'>"
            + _sdf_shape(
                "<capsule><radius>0.03</radius><length>0.1</length></capsule>",
                "<pose>0 0 0.08 0 0 0</pose>",
            )
            + _sdf_shape("<box><size>0.1 0.1 0.02</size></box>", "<pose>0 0 0.01 0 0 0</pose>")
            + "</link>",
            (0.1, 0.1, 0.16),
        ),
        (
            "<link name='a'>"
            + _sdf_shape("<ellipsoid><radii>0.03 0.05 0.04</radii></ellipsoid>", "")
            + "</link>",
            (0.06, 0.1, 0.08),
        ),
    ],
    ids=["degrees", "link", "joint", "frame", "model", "capsule", "ellipsoid"],
)
def test_poses_and_solids_of_sdf(tmp_path: Path, parts: str, size_m: tuple[float, ...]) -> None:
    (tmp_path / "a.sdf").write_text(f"<sdf version='1.9'><model name='a'>{parts}</model></sdf>")
    np.testing.assert_allclose(FolderObjects(tmp_path).load("a").size_m, size_m, atol=1e-3)


def test_geoms_of_a_frame_are_in_its_place(tmp_path: Path) -> None:
    board = '<frame pos="0 0 0.1" euler="0 0 90"><geom type="box" size="0.1 0.03 0.01"/></frame>'
    post = '<geom type="box" size="0.03 0.03 0.09"/>'
    (tmp_path / "a.xml").write_text(
        f"<mujoco><worldbody><body><freejoint/>{board}{post}</body></worldbody></mujoco>"
    )
    np.testing.assert_allclose(FolderObjects(tmp_path).load("a").size_m, (0.06, 0.2, 0.2), atol=1e-5)


def test_a_mass_of_some_geoms_is_not_that_of_the_object(tmp_path: Path) -> None:
    head = '<geom type="box" size=".05 .02 .02" mass="0.1"/>'
    shaft = '<geom type="box" size=".01 .01 .1" pos="0 0 -.12" density="700"/>'
    (tmp_path / "a.xml").write_text(f"<mujoco><worldbody><body>{head}{shaft}</body></worldbody></mujoco>")
    source = FolderObjects(tmp_path)
    volume_m3 = 8 * (0.05 * 0.02 * 0.02 + 0.01 * 0.01 * 0.1)
    assert source.load("a").mass_kg == pytest.approx(700 * volume_m3, rel=1e-4)
    assert "700" in source.notes["a"]["mass by density"]
