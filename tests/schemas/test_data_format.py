"""The data-format page says what the schemas say."""

from __future__ import annotations

from pathlib import Path

from datagen.schemas.data_format import page
from datagen.schemas.fields import SCHEMAS

PAGE = Path(__file__).parents[2] / "docs" / "data-format.md"


def test_the_page_is_up_to_date():
    assert PAGE.read_text() == page(), "run: python -m schemas.data_format > docs/data-format.md"


def test_every_field_has_a_unit_or_is_a_name_and_says_what_it_means():
    for schema in SCHEMAS.values():
        for f in (*schema.scene_fields, *schema.sample_fields):
            assert f.doc
            assert (f.unit == "") == f.is_text, f.name
            assert f"`{f.name}`" in page()
