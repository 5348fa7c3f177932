"""`datagen report` of runs, stores, checkpoints and evaluations: what the page says, and what it refuses."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.html_report import part_columns
from datagen.html_report.evaluation_file import read_evaluation
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from tests.datagen.html_report.conftest import HOSTILE, SCENES, quarantine
from tests.made_runs import make_run
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import PER_SCENE, arrays_of, make_small_run

CHECKPOINT = Path(__file__).parents[2] / "golden" / "checkpoint-format-1.ckpt"
# Elements that only text and figures need, and what loads or runs something.
_HARMLESS = {
    *("html", "head", "meta", "title", "style", "body", "h1", "h2", "h3", "h4", "p", "ul", "li", "a", "code"),
    *(
        "dl",
        "dt",
        "dd",
        "div",
        "table",
        "tr",
        "th",
        "td",
        "figure",
        "figcaption",
        "details",
        "summary",
        "pre",
    ),
    *(
        "section",
        "canvas",
        "button",
        "output",
        "img",
        "script",
        "svg",
        "g",
        "path",
        "defs",
        "use",
        "clippath",
    ),
    *("rect", "image"),
}


class Page(HTMLParser):
    """Tags, addresses, handlers of events and text of a page; the JSON of its scenes."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.handlers: list[str] = []
        self.scripts: list[str] = []
        self.scenes: list[dict[str, Any]] = []
        self.words: list[str] = []
        self.source = file.read_text(encoding="utf-8")
        self._inside: list[tuple[str, str]] = []
        self.feed(self.source)
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.handlers += [k for k, _ in attrs if k.startswith("on")]
        names = ("src", "href", "xlink:href", "srcset", "action", "data")
        self.addresses += [v for k, v in attrs if k in names and v]
        if tag in ("script", "style"):
            self._inside.append((tag, dict(attrs).get("type") or ""))

    def handle_endtag(self, tag: str) -> None:
        if self._inside and self._inside[-1][0] == tag:
            self._inside.pop()

    def handle_data(self, data: str) -> None:
        match self._inside[-1] if self._inside else None:
            case ("script", "application/json"):
                self.scenes.append(json.loads(data))
            case ("script", _):
                self.scripts.append(data)
            case None:
                self.words.append(data)


def report(out: Path, *words: str | Path) -> Page:
    assert cli.run(["report", *map(str, words), "--out", str(out)]) == 0
    return Page(out)


@pytest.fixture(scope="module")
def page(reported: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return report(tmp_path_factory.mktemp("page") / "page.html", reported, "--scenes", "3")


def test_a_page_says_what_the_run_holds(page: Page, reported: Path) -> None:
    stored = arrays_of(reported)
    share = f"{100 * stored['label'].mean():.1f}%"
    for words in (
        f"{SCENES * PER_SCENE} labels by heuristic", share, "10 of 10 committed", "complete, sealed",
        "built-in houses: Apache-2.0", Run.open(reported).manifest.spec_hash, "No shard is in quarantine.",
        "visibility", "per label", "Label balance", "Shards that stand out",
    ):  # fmt: skip
        assert words in page.text, words
    assert page.tags.count("svg") == 2 and page.tags.count("canvas") == 3 and page.tags.count("img") == 6
    assert set(page.tags) <= _HARMLESS


def test_a_view_has_the_cloud_and_the_base_poses(page: Page, reported: Path) -> None:
    stored = arrays_of(reported)
    shown = [int(k) for k in re.findall(r"Scene (\d+):", page.text)]
    assert len(shown) == len(set(shown)) == len(page.scenes) == 3
    for scene, view in zip(shown, page.scenes, strict=True):
        n = int(stored["n_points"][scene])
        packed = np.frombuffer(base64.b64decode(view["points"]), "<i2").reshape(-1, 3) * view["unit"]
        assert packed == pytest.approx(stored["points_m"][scene][:n].astype(float), abs=view["unit"])
        assert view["unit"] < 0.001
        rgb = np.frombuffer(base64.b64decode(view["rgb"]), np.uint8).reshape(-1, 3)
        np.testing.assert_array_equal(rgb, stored["rgb"][scene][:n])
        mask = np.frombuffer(base64.b64decode(view["target"]), np.uint8)
        np.testing.assert_array_equal(mask, stored["target_mask"][scene][:n])
        rows = stored["sample_scene_index"] == scene
        x, y, label, clear, _ = zip(*view["candidates"], strict=True)
        offset = stored["base_xy_m"][rows] - stored["target_center_m"][scene, :2]
        assert np.column_stack([x, y]) == pytest.approx(offset, abs=6e-4)
        assert list(label) == stored["label"][rows].tolist()
        assert list(clear) == stored["base_is_clear"][rows].tolist()
        assert view["floor"] == -stored["target_center_m"][scene, 2]


def test_a_page_runs_one_script_and_asks_for_nothing(page: Page) -> None:
    assert len(page.scripts) == 1 and not page.handlers
    assert all(address.startswith(("#", "data:image/")) for address in page.addresses)
    digest = base64.b64encode(hashlib.sha256(page.scripts[0].encode()).digest()).decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page.source)
    assert policy is not None and f"script-src 'sha256-{digest}'" in policy[1]
    assert "default-src 'none'" in policy[1] and "unsafe-eval" not in policy[1]


def test_no_text_of_a_run_acts_in_a_browser(hostile: Path, tmp_path: Path) -> None:
    page = report(tmp_path / "page.html", hostile, "--scenes", "2")
    assert set(page.tags) <= _HARMLESS and not page.handlers and len(page.scripts) == 1
    assert all(address.startswith(("#", "data:image/")) for address in page.addresses)
    assert "<script>alert(1)" in page.text and "shard 70 (in quarantine)" in page.text
    assert "Traceback of" in page.text and "\x1b" not in page.source and "\u202e" not in page.source
    assert f"house {HOSTILE[:20]}" in page.text and "cannot be drawn" in page.text


def test_one_seed_gives_one_page(reported: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        report(tmp_path / f"{name}.html", reported, "--scenes", "1")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_merged_runs_sealed_stores_and_runs_on_s3(reported: Path, bucket: str, tmp_path: Path) -> None:
    other = make_small_run(tmp_path / "other", 2 * PER_SCENE, "--seed", "7")
    assert cli.run(["merge", str(reported), str(other), "--out", str(tmp_path / "merged")]) == 0
    make_run(f"{bucket}/run", n=30)
    paths = (tmp_path / "merged", reported / "data.zarr", f"{bucket}/run")
    page = report(tmp_path / "page.html", *paths, "--scenes", "1")
    headings = re.findall(r'<h2 id="[^"]*">([^<]*)', page.source)
    assert len(headings) == 4 and sum("parts/" in heading for heading in headings) == 2
    assert "sealed store without its run" in page.text and "30 labels by heuristic" in page.text
    assert "2 shards: too few to find outliers" in page.text


def test_a_run_without_labels_shows_its_failures(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=[])
    quarantine(run, 1, "ValueError: no rays")
    page = report(tmp_path / "page.html", tmp_path / "run")
    for words in ("0 labels", "4 shards missing", "1 in quarantine", "Traceback of ValueError: no rays"):
        assert words in page.text, words


def test_pictures_are_left_out_where_the_houses_are_missing(reported: Path, tmp_path: Path) -> None:
    page = report(tmp_path / "page.html", reported, "--scenes", "1", "--houses", f"procthor:{tmp_path}/none")
    assert "Without pictures:" in page.text and "canvas" in page.tags and "img" not in page.tags


def test_what_is_sampled_is_said(reported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_columns, "MOST_SHARDS", 9)
    page = report(tmp_path / "page.html", reported, "--scenes", "1")
    sampled = f"a random 9 of 10 shards: {9 * PER_SCENE} of {10 * PER_SCENE} labels"
    assert f"From {sampled}." in page.text and f"scenes ({sampled})" in page.text


def test_runs_over_the_same_candidates_are_compared(reported: Path, tmp_path: Path) -> None:
    again = str(tmp_path / "again")
    assert cli.run(["relabel", str(reported), "--out", again, "--tau", "0.6"]) == 0
    page = report(tmp_path / "page.html", reported, again, "--scenes", "0")
    a, b = arrays_of(reported)["label"], arrays_of(Path(again))["label"]
    assert f"{100 * (a == b).mean():.1f}%" in page.text and "Agreement" in page.text
    assert "canvas" not in page.tags


def test_a_checkpoint_shows_its_training(tmp_path: Path) -> None:
    page = report(tmp_path / "page.html", CHECKPOINT)
    for words in ("shared, stage1", "1 epoch, the best is epoch 1", "versions", "training is not finished"):
        assert words in page.text, words
    assert page.tags.count("svg") == 1


def test_the_released_model_is_a_checkpoint(tmp_path: Path) -> None:
    assert "shared, sim-only" in report(tmp_path / "page.html", "released").text


@needs_sim
def test_an_evaluation_has_its_tables(evaluation: Path, tmp_path: Path) -> None:
    page = report(tmp_path / "page.html", evaluation)
    told = json.loads(evaluation.read_text())
    accuracy = told["parts"][0]["sets"]["in-range"]["methods"]["proximity"]["accuracy"]["value"]
    assert f"{100 * accuracy:.1f} [" in page.text and "Table I" in page.text and "Curves" in page.text
    assert page.tags.count("svg") == 2


@needs_sim
def test_names_of_methods_are_only_text(evaluation: Path, tmp_path: Path) -> None:
    text = evaluation.read_text().replace('"proximity"', json.dumps(HOSTILE))
    (tmp_path / "evaluation.json").write_text(text)
    page = report(tmp_path / "page.html", tmp_path / "evaluation.json")
    assert set(page.tags) <= _HARMLESS and not page.handlers and "<script>alert(1)" in page.text


def _without(*keys: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


def _with(value: Any, *keys: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


_SET = ("parts", 0, "sets", "in-range")


@needs_sim
@pytest.mark.parametrize(
    ("change", "field"),
    [
        (_without("methods"), "methods"),
        (_with([], "methods"), "methods"),
        (_with("many", *_SET, "count"), "parts.0.sets.in-range.count"),
        (_with(0, *_SET, "count"), "parts.0.sets.in-range.count"),
        (_with(float("nan"), *_SET, "methods", "analytic", "accuracy", "value"), "accuracy.value"),
        (_with(None, *_SET, "methods", "analytic", "area_under_roc", "value"), "area_under_roc.value"),
        (_without(*_SET, "methods", "analytic"), "in-range.methods"),
        (_without(*_SET, "curves", "analytic"), "in-range.curves"),
        (_with([0.5], *_SET, "curves", "analytic", "roc", "x"), "analytic.roc"),
        (_with(0.5, *_SET, "methods", "analytic", "brier"), "analytic.reliability"),
        (_with(None, "parts", 0, "no_grids"), "parts.0.no_grids"),
        (_with("x" * 5000, "datagen"), "datagen"),
    ],
)
def test_broken_evaluations_are_refused_by_field(
    change: Callable[[Any], None], field: str, evaluation: Path, tmp_path: Path
) -> None:
    document = json.loads(evaluation.read_text())
    change(document)
    (tmp_path / "broken.json").write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        read_evaluation(tmp_path / "broken.json")
    assert caught.value.field.endswith(field) and caught.value.place == str(tmp_path / "broken.json")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{missing}"], "is neither a run's folder nor a file"),
        (["{empty}"], "manifest.json"),
        (["{file}"], "not a datagen checkpoint"),
        (["{json}"], "Field required"),
        (["{text}"], "is not JSON"),
        (["{nothing}"], "is not JSON"),
        (["{run}", "--scenes", "51"], "--scenes"),
        (["{run}", "--seed", "-1"], "--seed"),
        (["{run}", "--out", "page.png"], "is not a .html or .htm file"),
        (["{run}", "--out", "/nowhere/page.html"], "its folder does not exist"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], said: str, reported: Path, places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = places["out"].parent
    named = {**places, "run": reported, "json": folder / "a.json", "text": folder / "b.json"}
    named["json"].write_text('{"methods": 3}')
    named["text"].write_text("{" + "[" * 5000)
    named["nothing"] = folder / "c.json"
    named["nothing"].write_text("")
    out = [] if "--out" in words else ["--out", str(folder / "page.html")]
    refused(["report", *(word.format(**named) for word in words), *out], capsys, said)
    assert not (folder / "page.html").exists()
