"""How options and the configuration file meet in a specification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

import datagen
from datagen.configuration.specify import specify
from datagen.configuration.toml_files import read_toml
from datagen.jobs.job_report import JobResult
from datagen.schemas.errors import InputError
from datagen.schemas.specification import Specification
from datagen.workers.houses import HouseSource, open_houses
from datagen.workers.houses.house import House
from datagen.workers.objects import open_objects
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG


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


QUICK = "[scene]\ndecisive = 0\n[arm.grasps]\nper_object = 24\nper_scene = 10\n"
MIX = {"top": 2, "shelf": 2, "inside": 3, "seat": 1, "floor": 1, "sink": 1}


def near(
    folder: Path, text: str, source: str = "plan", within: str | None = "in-range", robot: str | None = None,
    houses: HouseSource | None = None,
) -> Specification:  # fmt: skip
    """The specification of a file for builtin:40, without the engines' versions."""
    (folder / "run.toml").write_text(text)
    sources = houses or open_houses("builtin:40"), open_objects("builtin")
    options = {"candidates.within": within}
    spec = specify(source, *sources, options, folder / "run.toml", robot)
    return spec.model_copy(update={"engines": {}})


@needs_sim
@pytest.mark.parametrize("source", ["plan", "sim"])
def test_labels_within_reach_are_by_default_where_parking_decides(source: str, tmp_path: Path) -> None:
    spec = near(tmp_path, "", source)
    assert spec.scene.places is not None and spec.scene.places.weights() == MIX
    assert (spec.scene.n_clutter, spec.scene.decisive) == (14, 0.5)
    assert spec.candidates.robots_per_scene == 1
    told = near(tmp_path, "[scene]\nn_clutter = 3\ndecisive = 0\n", source)
    assert (told.scene.places, told.scene.n_clutter) == (spec.scene.places, 3)
    assert (told.scene.decisive, told.candidates.robots_per_scene) == (None, 4)
    # Scenes of several robots cannot be decisive.
    several = near(tmp_path, "[candidates]\nrobots_per_scene = 2\n", source)
    assert (several.scene.places, several.scene.decisive) == (spec.scene.places, None)


@needs_sim
@pytest.mark.parametrize(
    ("source", "within", "robot", "text", "digest"),
    [  # the hashes before there were such defaults
        ("plan", "in-range", None, "[scene]\nplaces = {}", "a331a4ebaefaa6e5"),
        ("plan", "in-range", None, "[scene]\nplaces = {}\ndecisive = 0", "a331a4ebaefaa6e5"),
        ("sim", "in-range", None, "[scene]\nplaces = {}", "ef9dfedfe2edb47d"),
        ("plan", "in-range", "panda", "[scene]\nplaces = {}", "3619c7ef66373779"),
        ("heuristic", "in-range", None, "", "b7ad87764efaed77"),
        ("heuristic", None, None, "[scene]\nplaces = {}", "1fcf793ca4e95751"),
        ("plan", None, None, "", "4b2fe0eed5ec6595"),
        ("plan", "clear", None, "", "0ce9cd776e02f238"),
    ],
)
def test_open_tops_alone_are_the_specification_that_they_were(
    source: str, within: str | None, robot: str | None, text: str, digest: str, tmp_path: Path
) -> None:
    if source != "heuristic":
        text += "\n[arm.motion]\npath_iterations = 200\n"  # their default then
    spec = near(tmp_path, text, source, within, robot)
    assert (spec.scene.places, spec.scene.decisive, spec.scene.n_clutter) == (None, None, 6)
    assert spec.hash().startswith(digest)


class Furnished:
    """Houses that have only the kinds of places of their list, or, for None, cannot be read."""

    kind, digest = "builtin", "1" * 64

    def __init__(self, kinds: Sequence[list[str] | None], opens: bool = True) -> None:
        self.kinds, self.opens, self.houses = kinds, opens, open_houses("builtin:1")

    def house_ids(self) -> list[str]:
        return [str(k) for k in range(len(self.kinds))]

    def load(self, house_id: str) -> House:
        kinds = self.kinds[int(house_id)]
        if kinds is None:
            raise InputError("houses.json", house_id, "is damaged", "Remove it")
        house = self.houses.load(self.houses.house_ids()[0])
        assert house.open_doors is not None
        surfaces = tuple(surface for surface in house.open_doors().surfaces if surface.kind in kinds)
        opened = replace(house, surfaces=surfaces)
        return replace(opened, open_doors=(lambda: opened) if self.opens else None)


@needs_sim
def test_kinds_of_places_that_houses_lack_or_the_arm_cannot_reach_are_left_out(tmp_path: Path) -> None:
    def kinds(houses: Sequence[list[str] | None], text: str = "") -> set[str] | None:
        places = near(tmp_path, text, houses=Furnished(houses)).scene.places
        return None if places is None else {kind for kind, weight in places.weights().items() if weight}

    assert kinds([["top"], None, ["top", "floor"]]) == {"top", "floor"}
    assert kinds([["top"]] * 18 + [["top", "sink"]] * 2) is None  # in a tenth of them
    assert kinds([["top"]] * 17 + [["top", "sink"]] * 3) == {"top", "sink"}
    assert kinds([None]) is None and kinds([["top"]]) is None
    assert near(tmp_path, "", houses=Furnished([["top", "floor"]], opens=False)).scene.places is None
    low = "[candidates]\narm_reach_m = {low = 0.3, high = 0.4}\nbase_height_m = {low = 0.8, high = 0.8}\n"
    assert kinds([["top", "floor", "sink"]]) == {"top", "floor", "sink"}
    assert kinds([["top", "floor", "sink"]], low) == {"top", "sink"}
    high = "[scene]\nsupport_height_m = {low = 0.9, high = 1.2}\n"
    assert kinds([["seat", "floor"]], high) == {"floor"}


@needs_sim
def test_a_run_by_default_says_where_its_targets_stand(tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text(CONFIG + QUICK)
    run = tmp_path / "run"

    def made(n: int) -> JobResult:
        config = tmp_path / "run.toml"
        return datagen.submit(
            "plan",
            n=n,
            out=run,
            candidates="in-range",
            candidates_per_scene=4,
            config=config,
            workers=0,
            quiet=True,
        )

    assert made(8).made_from.endswith(", places top/shelf/inside/seat/floor/sink")
    assert made(8).labels == 0
    assert datagen.resume(run, n=12, workers=0, quiet=True).complete
    rule = datagen.submit("heuristic", n=12, scenes_from=run, out=tmp_path / "rule", workers=0, quiet=True)
    places = [datagen.candidates(out)["place"].tolist() for out in (run, tmp_path / "rule")]
    assert rule.complete and places[0] == places[1] and len(set(places[0])) > 1


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


def test_a_mark_at_the_beginning_is_no_part_of_a_configuration(tmp_path: Path) -> None:
    config = tmp_path / "run.toml"
    found = list[str]()
    for encoding in ("utf-8", "utf-8-sig"):  # the latter as Notepad writes it
        config.write_text("[candidates]\nper_scene = 7\n", encoding)
        builtin = open_houses("builtin"), open_objects("builtin")
        found.append(specify("heuristic", *builtin, {}, config).model_dump_json())
    assert found[0] == found[1]


def test_many_decimals_and_dots_in_text_are_no_deep_key(tmp_path: Path) -> None:
    (file := tmp_path / "a.toml").write_text(
        f'poses = [{"[0.25, -1.5], " * 300}]  # {"." * 500}\ntext = "{"a." * 500}"\n'
    )
    assert read_toml(file) == {"poses": [[0.25, -1.5]] * 300, "text": "a." * 500}
