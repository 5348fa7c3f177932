"""Files of robots that cannot be used, and meshes of every format."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.workers.robots import open_robot, robot_limits
from tests.workers.robots.conftest import ENDS, LIMIT, Made


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
