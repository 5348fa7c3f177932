"""`datagen report` of runs and models: contents of the page, and refusals."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.html_report import run_columns
from datagen.html_report.run_columns import RunColumns, read_columns
from datagen.schemas.run import Run
from tests.datagen.html_report.conftest import SCENES, quarantine
from tests.datagen.html_report.page import Page
from tests.made_runs import make_run
from tests.refusals import refused
from tests.small_runs import PER_SCENE, arrays_of, make_small_run


def report(out: Path, *words: str | Path) -> Page:
    assert cli.run(["report", *map(str, words), "--out", str(out)]) == 0
    return Page(out.read_text(encoding="utf-8"))


def columns_of(path: Path) -> RunColumns:
    columns = read_columns(Run.open(str(path)))
    assert columns is not None
    return columns


def test_a_page_describes_the_run(reported: Path, tmp_path: Path) -> None:
    page, stored = report(tmp_path / "page.html", reported), arrays_of(reported)
    near = stored["base_is_clear"] & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    for words in (
        f"{SCENES * PER_SCENE} of {SCENES * PER_SCENE}, by heuristic: complete",
        f"{100 * stored['label'].mean():.1f}% of all base poses",
        f"{100 * stored['label'][near].mean():.1f}% of the {100 * near.mean():.0f}%",
        *("Labels on the floor", "Causes of failure", "No attempt failed", "Cost", "3 scenes", "Provenance"),
        *("built-in houses: Apache-2.0", Run.open(str(reported)).manifest.spec_hash),
    ):
        assert words in page.text, words
    assert page.tags.count("svg") == 1 and page.tags.count("img") == 6
    page.check_harmless()
    report(tmp_path / "again.html", reported)
    assert (tmp_path / "again.html").read_bytes() == (tmp_path / "page.html").read_bytes()


def test_columns_are_those_of_the_store(reported: Path) -> None:
    columns, stored = columns_of(reported), arrays_of(reported)
    np.testing.assert_array_equal(columns.label, stored["label"] == 1)
    np.testing.assert_allclose(np.linalg.norm(columns.offset_m, axis=1), stored["distance_m"], atol=1e-5)
    causes = columns.causes()
    assert (np.sum(list(causes.values()), axis=0) == 1).all()
    good = np.sum([rows for name, rows in causes.items() if name.startswith("good")], axis=0)
    np.testing.assert_array_equal(good == 1, columns.label)


def test_the_camera_is_below_the_target(reported: Path) -> None:
    stored = arrays_of(reported)
    base = {"base_xy_m": stored["T_world_camera"][:, :2, 3], "target_center_m": stored["target_center_m"]}
    turned = run_columns.turned(base | {"T_world_camera": stored["T_world_camera"]}, np.arange(SCENES))
    np.testing.assert_allclose(turned[:, 0], 0, atol=1e-6)
    assert (turned[:, 1] < 0).all()


def test_a_large_run_is_read_in_part(reported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_columns, "MOST_SHARDS", 4)
    assert columns_of(reported).scenes.tolist() == [0, 3, 6, 9]
    assert "4 of 10 shards, evenly spaced" in report(tmp_path / "page.html", reported).text


def test_texts_of_a_run_do_nothing_in_a_browser(hostile: Path, tmp_path: Path) -> None:
    page = report(tmp_path / "page.html", hostile)
    page.check_harmless()
    assert "<script>alert(1)" in page.text and "shard 70 is in quarantine" in page.text
    assert "\x1b" not in page.source and "\u202e" not in page.source
    assert "Without pictures" in page.text


def test_each_part_of_a_merged_run_and_a_run_on_s3_has_a_section(
    reported: Path, bucket: str, tmp_path: Path
) -> None:
    other = make_small_run(tmp_path / "other", 2 * PER_SCENE, "--seed", "7")
    assert cli.run(["merge", str(reported), str(other), "--out", str(tmp_path / "merged")]) == 0
    make_run(f"{bucket}/run", n=30)
    page = report(tmp_path / "page.html", tmp_path / "merged", f"{bucket}/run")
    headings = re.findall(r'<h2 id="[^"]*">([^<]*)', page.source)
    assert len(headings) == 3 and sum("parts/" in heading for heading in headings) == 2
    assert page.addresses[:3] == ["#part-0", "#part-1", "#part-2"] and "30 of 30" in page.text


def test_a_run_without_labels_shows_its_failures(tmp_path: Path) -> None:
    quarantine(make_run(tmp_path / "run", shards=[]), 1, "ValueError: no rays")
    page = report(tmp_path / "page.html", tmp_path / "run")
    for words in ("0 of ", "4 shards missing", "shard 1 is in quarantine: ValueError: no rays"):
        assert words in page.text, words


def test_a_model_shows_its_training(tmp_path: Path) -> None:
    page = report(tmp_path / "page.html", "released")
    for words in (
        "shared, trained as sim-only",
        "% of the labels of validation",
        "Course of training",
        "sha256",
    ):
        assert words in page.text, words
    assert page.tags.count("svg") == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{missing}"], "is neither a run's folder nor a file"),
        (["{empty}"], "manifest.json"),
        (["{file}"], "not a datagen checkpoint"),
        (["{run}", "--out", "page.png"], "is not a .html or .htm file"),
        (["{run}", "--out", "/nowhere/page.html"], "its folder does not exist"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], said: str, reported: Path, places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    out = places["out"].parent / "page.html"
    named = [word.format(**places, run=reported) for word in words]
    refused(["report", *named, *([] if "--out" in words else ["--out", str(out)])], capsys, said)
    assert not out.exists()
