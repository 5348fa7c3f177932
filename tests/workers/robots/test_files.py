"""The URDF that is written for engines that read files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")

from datagen.workers.robots import open_robot
from datagen.workers.robots.robot_files import write_urdf
from datagen.workers.robots.urdf import read_urdf


@pytest.mark.parametrize("reach_m", [0.35, 0.8])
def test_parts_in_files_are_those_of_the_links(tmp_path: Path, reach_m: float) -> None:
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
