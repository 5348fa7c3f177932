"""How options and the configuration file meet in a specification."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.configuration.specify import specify
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects


@pytest.mark.parametrize(
    ("file", "option", "robots"),
    [
        ("", None, 4),
        ("", "grid", 1),
        ("per_scene = 'grid'", None, 1),
        ("robots_per_scene = 2", "grid", 2),
        ("per_scene = 'grid'\nrobots_per_scene = 3", None, 3),
        ("per_scene = 'grid'", 60, 4),
    ],
)
def test_one_robot_stands_on_a_whole_grid_unless_another_number_is_given(
    file: str, option: str | int | None, robots: int, tmp_path: Path
) -> None:
    config = tmp_path / "run.toml"
    config.write_text(f"[candidates]\n{file}\n")
    options = {"candidates.per_scene": option, "candidates.robots_per_scene": None}
    spec = specify("heuristic", open_houses("builtin"), open_objects("builtin"), options, config)
    assert spec.candidates.robots_per_scene == robots
