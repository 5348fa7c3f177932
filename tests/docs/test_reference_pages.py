"""Pages of reference say what the schemas say, and the example of a specification is a real one."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable

import pytest

import datagen
from datagen.commands.submit import SubmitOptions
from datagen.configuration.specify import specify
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.specification import (
    ArmParams,
    CandidateParams,
    DisturbanceParams,
    MotionParams,
    SceneParams,
    Source,
    Specification,
    TrialParams,
    Turns,
)
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from scripts import data_format_page, specification_page
from tests.conftest import REPOSITORY
from tests.sim_extra import needs_robots, needs_sim

SOURCES = {"houses": Source(kind="a", digest="1" * 64), "objects": Source(kind="b", digest="2" * 64)}


@pytest.mark.parametrize(
    ("name", "page"), [("data-format", data_format_page.page), ("specification", specification_page.page)]
)
def test_a_page_is_up_to_date(name: str, page: Callable[[], str]) -> None:
    assert (REPOSITORY / f"docs/reference/{name}.md").read_text("utf-8") == page(), "run `make docs`"


@needs_sim
@needs_robots
def test_the_page_of_robots_is_up_to_date() -> None:
    from scripts import robots_page

    assert (REPOSITORY / "docs/reference/robots.md").read_text("utf-8") == robots_page.page(), (
        "run `make docs`"
    )


def test_the_page_of_python_has_all_that_the_package_offers() -> None:
    page = (REPOSITORY / "docs/reference/python.md").read_text("utf-8")
    named = {"label_sources", "houses", "objects", "robots"}  # of registries, in the guide
    offered = [name for name in datagen.__all__ if name not in named | {"__version__", "TorchStream"}]
    assert [name for name in offered if f"{name}\n" not in page] == []


def test_every_field_has_a_unit_or_is_a_name_and_says_what_it_means() -> None:
    for schema in SCHEMAS.values():
        for f in (*schema.scene_fields, *schema.sample_fields):
            assert f.doc
            assert (f.unit == "") == f.is_text, f.name
            assert f"`{f.name}`" in data_format_page.page()


def test_the_example_of_a_specification_has_the_defaults_also_where_it_comments_out() -> None:
    example = re.search(r"```toml\n(.*?)```", specification_page.page(), re.DOTALL)
    assert example is not None
    fields = tomllib.loads(example[1])
    assert Specification.model_validate(SOURCES | fields) == Specification.model_validate(SOURCES)
    assert fields["candidates"]["per_scene"] == 60
    fields = tomllib.loads(re.sub(r"^# ", "", example[1], flags=re.MULTILINE))
    spec = Specification.model_validate(SOURCES | fields)
    assert spec.arm == ArmParams(trial=TrialParams(), disturbance=DisturbanceParams())
    assert set(fields["arm"]) == set(ArmParams.model_fields) - {"robot_digest", "joints", "draws"}
    corners = ((0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2), (0.3, -0.2))
    turns = Turns(low=-0.5, high=0.5)
    near = {"within": "in-range", "in_range_by": "reachable-set"}
    absent = {**near, "scaled_base": True, "footprint_m": corners, "yaw_rad": turns}
    assert spec.candidates == CandidateParams(**absent)


@needs_sim
@needs_robots
@pytest.mark.parametrize("within", [None, "clear", "in-range"])
@pytest.mark.parametrize(
    ("source", "robot"), [("heuristic", None), ("plan", "panda-scaled"), ("plan", "ur5"), ("sim", "stretch3")]
)
def test_the_page_names_what_submit_sets(source: str, robot: str | None, within: str | None) -> None:
    made_of = open_houses("builtin"), open_objects("builtin")
    spec = specify(source, *made_of, {"candidates.within": within}, None, robot)
    set_by_submit = set[str]()
    sections = [(spec.candidates, CandidateParams()), (spec.scene, SceneParams())]
    if spec.arm is not None:
        sections.append((spec.arm.motion, MotionParams()))
        set_by_submit |= {"arm.trial"} if spec.arm.trial is not None else set()
    for found, default in sections:
        set_by_submit |= {name for name, value in found if value != getattr(default, name)}
    told = specification_page.page().partition("```toml")[0]
    assert [name for name in set_by_submit - {"within"} if name not in told] == []
    text = str(SubmitOptions.__annotations__["candidates_per_scene"])
    is_grid = spec.candidates.per_scene == "grid"
    assert is_grid == (source != "heuristic" and within is None)
    assert "[default: 60; grid for plan and sim of all cells]" in text
