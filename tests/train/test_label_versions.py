"""Labels of different versions are not mixed silently."""

from __future__ import annotations

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.specification import Source, Specification
from datagen.train.label_versions import refuse_mixed_labels


def specification(source: str, version: str) -> Specification:
    assets = Source(kind="builtin", digest="1" * 64)
    return Specification(label_source=source, houses=assets, objects=assets, engines={"labels": version})


def test_versions_of_one_source_are_not_mixed() -> None:
    old, new = specification("sim", "1"), specification("sim", "2")
    refuse_mixed_labels([("a", new), ("b", new), ("c", specification("plan", "1"))])
    with pytest.raises(InputError, match="sim labels are of version 2, those of a of version 1") as error:
        refuse_mixed_labels([("a", old), ("b", new)])
    assert "--allow-mixed-labels" in str(error.value) and "\n" not in str(error.value)
