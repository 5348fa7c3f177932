"""A real small disk, to fill, and runs of few arrays."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from datagen.schemas.fields import SCHEMAS
from tests.schemas.checked import few_fields


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of 512 KiB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small file system can be mounted by root alone")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture(scope="module")
def few_arrays() -> Iterator[None]:
    """Heuristic runs of few arrays: stores of fifty take the same paths."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCHEMAS, "heuristic", few_fields())
        yield
