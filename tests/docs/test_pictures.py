"""The pictures of the documents are those that the present program draws."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scripts.pictures import IMAGES, PICTURES, ROBOTS, make
from tests.conftest import REPOSITORY
from tests.sim_extra import needs_robots, needs_sim

# Those that need planning or physics take longer than a test of every change may.
SLOW = {"outcomes.png", "trial.png"}
TRIALS = {f"{robot}.webp" for robot in ROBOTS}


def marks(name: str) -> list[pytest.MarkDecorator]:
    if name not in SLOW | TRIALS:
        return []
    return [needs_sim, pytest.mark.slow, *([needs_robots] if name in TRIALS else [])]


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in PICTURES])
def test_a_picture_is_that_of_the_present_program(name: str, tmp_path: Path) -> None:
    make(name, tmp_path / name)
    with Image.open(tmp_path / name) as drawn, Image.open(IMAGES / name) as kept:
        assert drawn.size == kept.size, "draw it again: make pictures"
        a, b = (np.asarray(image.convert("RGB"), np.float64) for image in (drawn, kept))
    # Another processor may round a ray to the next pixel; a changed label, legend or colour differs by more.
    assert (np.abs(a - b).max(axis=2) > 32).mean() < 2e-4, "draw it again: make pictures"


def test_every_picture_of_the_documents_has_a_command_and_is_shown() -> None:
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")]
    shown = {name for page in pages for name in re.findall(r"images/([\w.-]+)", page.read_text())}
    assert shown == set(PICTURES) == {path.name for path in IMAGES.iterdir()}


def test_the_first_picture_is_that_of_the_demo() -> None:
    demo = (REPOSITORY / "Makefile").read_text()
    for words in PICTURES["labels.png"]:
        shared = " ".join(words[: words.index("--out")]).replace("show run", "show $(DEMO)/run")
        assert shared in demo
