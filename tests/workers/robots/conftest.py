"""A small robot whose files the tests write and change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

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
