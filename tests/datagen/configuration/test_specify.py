"""How options and the configuration file meet in a specification."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.configuration.specify import specify
from datagen.configuration.toml_files import read_toml
from datagen.schemas.errors import InputError
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


@pytest.mark.parametrize(("robot", "scaled"), [(None, True), ("panda-scaled", True), ("fetch", None)])
def test_new_runs_scale_the_bases_of_robots_that_have_none_of_their_own(
    robot: str | None, scaled: bool | None, tmp_path: Path
) -> None:
    sources = open_houses("builtin"), open_objects("builtin")
    assert specify("heuristic", *sources, {}, None, robot).candidates.scaled_base is scaled
    config = tmp_path / "run.toml"
    config.write_text("[candidates]\nscaled_base = false\n")
    assert specify("heuristic", *sources, {}, config, robot).candidates.scaled_base is False


def test_scenes_with_a_required_set_have_a_version_of_their_own() -> None:
    sources = open_houses("builtin"), open_objects("builtin")
    versions = [
        specify("heuristic", *sources, {"candidates.within": within}, None).engines["scenes"]
        for within in (None, "clear", "in-range")
    ]
    assert versions == ["1", "2", "2"]


@pytest.mark.parametrize(
    "text",
    [
        "a." * 50_000 + "a = 1",
        '"," . ' * 50_000 + "a = 1",
        "[" + "scene." * 50_000 + "a]",
        "a = " + f"{{{'a.' * 190}a = " * 90 + "1" + "}" * 90,
    ],
    ids=["key", "quoted", "table", "values"],
)
def test_deeply_nested_configurations_are_refused(text: str, tmp_path: Path) -> None:
    """The parser needs gigabytes for such keys, and messages cannot show what it reads."""
    config = tmp_path / "run.toml"
    config.write_text(text)
    with pytest.raises(InputError, match=r"run\.toml: is not TOML"):
        specify("heuristic", open_houses("builtin"), open_objects("builtin"), {}, config)


def test_many_decimals_and_dots_in_text_are_no_deep_key(tmp_path: Path) -> None:
    (file := tmp_path / "a.toml").write_text(
        f'poses = [{"[0.25, -1.5], " * 300}]  # {"." * 500}\ntext = "{"a." * 500}"\n'
    )
    assert read_toml(file) == {"poses": [[0.25, -1.5]] * 300, "text": "a." * 500}
