"""The leaderboard is the page of its entries, and an entry is of all runs of this version."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from datagen import cli
from datagen.evaluation.benchmark import read_benchmark, shipped_pack
from datagen.schemas.errors import InputError
from scripts import leaderboard_page
from tests.conftest import REPOSITORY


def test_the_page_is_up_to_date() -> None:
    kept = (REPOSITORY / "docs/results/leaderboard.md").read_text("utf-8")
    assert kept == leaderboard_page.page(), "run `make docs`"


def test_a_method_that_was_scored_on_the_pack_becomes_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = tmp_path / "board.json"
    words = ["benchmark", "score", "reach-share", "proximity", "--out", str(board)]
    assert cli.run(words) == 0
    some = json.loads(board.read_text())
    entries = tmp_path / "entries"
    shutil.copytree(leaderboard_page.FOLDER, entries)
    monkeypatch.setattr(leaderboard_page, "FOLDER", entries)
    for name, value in (("not_scored", ["grids-ur5"]), ("digest", "0" * 64)):
        (tmp_path / "part.json").write_text(
            json.dumps(some | {"benchmark": some["benchmark"] | {name: value}})
        )
        with pytest.raises(InputError, match="is not this version with all of its runs"):
            leaderboard_page.main([str(tmp_path / "part.json"), "reach-share", "rule", "a rule"])
    with pytest.raises(InputError, match="Did you mean proximity"):
        leaderboard_page.main([str(board), "proximty", "rule", "a rule"])
    leaderboard_page.main([str(board), "reach-share", "mine", "about mine"])
    good = some["parts"][0]["grids"]["methods"]["reach-share"]["good"]["value"]
    entry = json.loads((entries / "pack" / "mine.json").read_text())
    assert some["parts"][0]["title"] == "grids" and entry["grids"]["grids"]["good"][0] == round(100 * good, 1)
    before, pack = leaderboard_page.page().split("## On the pack")
    assert f"| mine | {round(100 * good, 1)}" in pack and "- **mine:** about mine" in pack
    assert "mine" not in before


def test_a_method_that_was_scored_on_all_runs_leads_the_other_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = tmp_path / "board.json"
    assert cli.run(["benchmark", "score", "reach-share", "proximity", "--out", str(board)]) == 0
    both = read_benchmark(shipped_pack())
    folders = {tmp_path / "runs": both, tmp_path / "pack": both}
    for folder in folders:
        monkeypatch.setattr(leaderboard_page, "boards", lambda folder=folder: {folder: both})
        for method in ("proximity", "reach-share"):
            leaderboard_page.main([str(board), method, method, f"about {method}"])
    monkeypatch.setattr(leaderboard_page, "boards", lambda: folders)
    tables = [each.count("| reach-share | ") for each in leaderboard_page.page().split("## ")]
    assert tables == [0, 1, 1, 1, 1, 1, 0, 0]
