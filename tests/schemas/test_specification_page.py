"""The page of the specification is what the models say, and its example is a real configuration."""

from __future__ import annotations

import re
import tomllib

from schemas.specification import Source, Specification
from schemas.specification_page import page
from tests.conftest import REPOSITORY

SOURCES = {"houses": Source(kind="a", digest="1" * 64), "objects": Source(kind="b", digest="2" * 64)}


def test_the_page_is_up_to_date() -> None:
    assert (REPOSITORY / "docs" / "specification.md").read_text("utf-8") == page(), "run `make docs`"


def test_its_example_is_the_defaults() -> None:
    example = re.search(r"```toml\n(.*?)```", page(), re.DOTALL)
    assert example is not None
    fields = tomllib.loads(example.group(1))
    assert Specification.model_validate(SOURCES | fields) == Specification.model_validate(SOURCES)
    assert fields["candidates"]["per_scene"] == 60
