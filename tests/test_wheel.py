"""The built wheel: one import name, and every file that the package ships."""

from __future__ import annotations

import zipfile
from pathlib import Path

from tests.conftest import REPOSITORY
from tests.linked_environments import wheel

__all__ = ["wheel"]


def test_a_wheel_adds_one_import_name_with_the_benchmark_the_model_and_its_frame(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    names = {name.split("/")[0] for name in sizes}
    assert {name for name in names if not name.endswith(".dist-info")} == {"datagen"}
    for folder in ("released", "evaluation/pack"):
        for path in (REPOSITORY / "datagen" / folder).rglob("*"):
            if path.is_file() and path.suffix != ".pyc":
                assert sizes[str(path.relative_to(REPOSITORY))] == path.stat().st_size
    assert sum(size for name, size in sizes.items() if name.startswith("datagen/released/")) < 5_500_000
