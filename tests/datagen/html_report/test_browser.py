"""A report in a real browser: nothing fails or is fetched, all is drawn, it fits a phone, keys scroll it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from tests.browser import browser, open_page

SIZES = {"wide": {"width": 1280, "height": 900}, "narrow": {"width": 400, "height": 800}}


@pytest.fixture(scope="module")
def opened() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def page_file(reported: Path, hostile: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of a run, of a hostile copy of it, and of a model."""
    out = tmp_path_factory.mktemp("browser") / "page.html"
    assert cli.run(["report", str(reported), str(hostile), "released", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize(("size", "scheme"), [("wide", "light"), ("narrow", "dark")])
def test_nothing_fails_and_nothing_is_fetched(opened: Any, page_file: Path, size: str, scheme: str) -> None:
    page, watched = open_page(opened, page_file, viewport=SIZES[size], color_scheme=scheme)
    for element in page.query_selector_all("details"):
        element.evaluate("(details) => { details.open = true; }")
    assert (watched.console, watched.requests) == ([], [])
    assert page.evaluate("document.documentElement.scrollWidth") == SIZES[size]["width"]
    page.close()


def test_figures_and_pictures_are_drawn(opened: Any, page_file: Path) -> None:
    page, _ = open_page(opened, page_file, viewport=SIZES["wide"])
    boxes = page.eval_on_selector_all(
        "figure > svg, .pictures img",
        "(all) => all.map((e) => [e.tagName, e.clientWidth, e.clientHeight, e.naturalWidth])",
    )
    kinds = [kind.lower() for kind, *_ in boxes]
    # Two floors and one training; the hostile run has no pictures.
    assert (kinds.count("svg"), kinds.count("img")) == (3, 6)
    assert all(width > 200 and height > 100 and natural != 0 for _, width, height, natural in boxes)
    page.close()


def test_keys_scroll_a_figure_that_is_wider_than_a_phone(opened: Any, page_file: Path) -> None:
    page, _ = open_page(opened, page_file, viewport=SIZES["narrow"])
    page.locator("figure").first.focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.querySelector('figure').scrollLeft > 0")
    page.close()
