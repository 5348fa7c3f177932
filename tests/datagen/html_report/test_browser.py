"""A report in a real browser: nothing fails or is fetched, figures are drawn, views turn, it fits a phone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from tests.browser import Watched, browser, open_page

CHECKPOINT = Path(__file__).parents[2] / "golden" / "checkpoint-format-1.ckpt"
SIZES = {"wide": {"width": 1280, "height": 900}, "narrow": {"width": 400, "height": 800}}


@pytest.fixture(scope="module")
def opened() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def page_file(reported: Path, hostile: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of a run, of hostile copies of it, and of a checkpoint."""
    out = tmp_path_factory.mktemp("browser") / "page.html"
    words = ["report", str(reported), str(hostile), str(CHECKPOINT), "--scenes", "2", "--out", str(out)]
    assert cli.run(words) == 0
    return out


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_nothing_fails_and_nothing_is_fetched(opened: Any, page_file: Path, size: str, scheme: str) -> None:
    page, watched = open_page(opened, page_file, viewport=SIZES[size], color_scheme=scheme)
    page.wait_for_function("[...document.querySelectorAll('canvas')].every((c) => c.dataset.view)")
    for element in page.query_selector_all("details"):
        element.evaluate("(details) => { details.open = true; }")
    assert (watched.console, watched.requests) == ([], [])
    assert page.evaluate("document.documentElement.scrollWidth") == SIZES[size]["width"]
    page.close()


def test_figures_and_pictures_are_drawn(opened: Any, page_file: Path) -> None:
    page, _ = open_page(opened, page_file, viewport=SIZES["wide"])
    boxes = page.eval_on_selector_all(
        "figure > svg, .pictures img, canvas",
        "(all) => all.map((e) => [e.tagName, e.clientWidth, e.clientHeight, e.naturalWidth])",
    )
    kinds = [kind.lower() for kind, *_ in boxes]
    # Two runs of two figures and two views, and one training; the hostile scene has no picture.
    assert (kinds.count("svg"), kinds.count("canvas")) == (5, 4) and 4 <= kinds.count("img") <= 6
    assert all(width > 200 and height > 100 and natural != 0 for _, width, height, natural in boxes)
    for k in range(4):
        assert _colours(page, k) > 20
    page.close()


def _colours(page: Any, k: int) -> int:
    """Number of colours on a canvas."""
    return page.evaluate(
        """(k) => {
          const c = document.querySelectorAll("canvas")[k];
          const data = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
          return new Set(new Uint32Array(data.buffer)).size;
        }""",
        k,
    )


@pytest.fixture
def view(opened: Any, page_file: Path) -> Iterator[tuple[Any, Any, Watched]]:
    """A page, its first view, and what happens."""
    page, watched = open_page(opened, page_file, viewport=SIZES["narrow"], has_touch=True)
    canvas = page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    page.wait_for_function("document.querySelector('canvas').dataset.view")
    yield page, canvas, watched
    assert (watched.console, watched.requests) == ([], [])
    page.close()


def _state(page: Any, canvas: Any) -> tuple[tuple[float, ...], str]:
    """Yaw, pitch and zoom, and the picture, once it is drawn."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    numbers = canvas.get_attribute("data-view").split()
    return tuple(map(float, numbers)), canvas.evaluate("(c) => c.toDataURL()")


@pytest.mark.parametrize(
    ("key", "number", "sign"),
    [
        ("ArrowLeft", 0, -1),
        ("ArrowRight", 0, 1),
        ("ArrowUp", 1, 1),
        ("ArrowDown", 1, -1),
        ("+", 2, 1),
        ("-", 2, -1),
    ],
)
def test_keys_turn_the_view(view: tuple[Any, Any, Watched], key: str, number: int, sign: int) -> None:
    page, canvas, _ = view
    canvas.focus()
    (before, picture), scrolled = _state(page, canvas), page.evaluate("window.scrollY")
    page.keyboard.press(key)
    after, turned = _state(page, canvas)
    assert sign * (after[number] - before[number]) > 0 and turned != picture
    assert [a for k, a in enumerate(after) if k != number] == [b for k, b in enumerate(before) if k != number]
    page.keyboard.press("Home")
    assert _state(page, canvas) == (before, picture)
    assert page.evaluate("window.scrollY") == scrolled  # the arrows did not scroll the page as well


def test_base_poses_are_named_by_keys(view: tuple[Any, Any, Watched]) -> None:
    page, canvas, _ = view
    canvas.focus()
    output = page.locator("output").first
    page.keyboard.press("n")
    first = output.inner_text()
    assert first.startswith("Base pose 0: ") and " m from the target" in first
    page.keyboard.press("n")
    assert output.inner_text().startswith("Base pose 1: ")
    page.keyboard.press("p")
    assert output.inner_text() == first


def test_every_control_is_reached_by_tab_and_buttons_turn(view: tuple[Any, Any, Watched]) -> None:
    page, canvas, _ = view
    canvas.focus()
    before, _ = _state(page, canvas)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.ariaLabel") == "turn left"
    page.keyboard.press("Enter")
    assert _state(page, canvas)[0][0] < before[0]


def test_mouse_and_wheel_turn_and_zoom(view: tuple[Any, Any, Watched]) -> None:
    page, canvas, _ = view
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before, picture = _state(page, canvas)
    page.mouse.move(x, y)
    page.mouse.wheel(0, -120)  # without focus the wheel scrolls the page
    assert _state(page, canvas)[0] == before
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60, y + 30, steps=4)
    page.mouse.up()
    turned, other = _state(page, canvas)
    assert turned[0] > before[0] and turned[1] > before[1] and other != picture
    canvas.focus()
    page.mouse.wheel(0, -120)
    page.wait_for_function(f"+document.querySelector('canvas').dataset.view.split(' ')[2] > {before[2]}")


def test_touch_turns_and_pinch_zooms(view: tuple[Any, Any, Watched]) -> None:
    page, canvas, _ = view
    before, _ = _state(page, canvas)
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def send(kind: str, *points: tuple[float, float]) -> None:
        named = [{"x": a, "y": b, "id": k} for k, (a, b) in enumerate(points)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": named})

    send("touchStart", (x, y))
    for step in range(1, 6):
        send("touchMove", (x + 20 * step, y))
    send("touchEnd")
    turned, _ = _state(page, canvas)
    assert turned[0] < before[0]
    send("touchStart", (x - 20, y), (x + 20, y))
    for step in range(1, 6):
        send("touchMove", (x - 20 - 10 * step, y), (x + 20 + 10 * step, y))
    send("touchEnd")
    assert _state(page, canvas)[0][2] > before[2]
