"""The page of the specification is what the models say, and its example is a real configuration."""

from __future__ import annotations

import re
import tomllib

from datagen.schemas.specification import (
    ArmParams,
    CandidateParams,
    DisturbanceParams,
    Source,
    Specification,
    TrialParams,
)
from scripts.specification_page import page
from tests.conftest import REPOSITORY

SOURCES = {"houses": Source(kind="a", digest="1" * 64), "objects": Source(kind="b", digest="2" * 64)}


def test_the_page_is_up_to_date() -> None:
    assert (REPOSITORY / "docs" / "reference" / "specification.md").read_text("utf-8") == page(), (
        "run `make docs`"
    )


def test_its_example_is_the_defaults() -> None:
    example = re.search(r"```toml\n(.*?)```", page(), re.DOTALL)
    assert example is not None
    fields = tomllib.loads(example.group(1))
    assert Specification.model_validate(SOURCES | fields) == Specification.model_validate(SOURCES)
    assert fields["candidates"]["per_scene"] == 60


def test_what_it_comments_out_are_the_defaults_of_what_is_absent() -> None:
    example = re.search(r"```toml\n(.*?)```", page(), re.DOTALL)
    assert example is not None
    fields = tomllib.loads(re.sub(r"^# ", "", example.group(1), flags=re.MULTILINE))
    spec = Specification.model_validate(SOURCES | fields)
    assert spec.arm == ArmParams(trial=TrialParams(), disturbance=DisturbanceParams())
    assert set(fields["arm"]) == set(ArmParams.model_fields)
    assert spec.candidates == CandidateParams(within="clear", scaled_base=True)
