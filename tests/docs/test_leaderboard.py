"""The leaderboard is the page of its entries, and an entry is of all runs of this version."""

from __future__ import annotations

import json
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


def test_a_method_becomes_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board = tmp_path / "board.json"
    words = ["benchmark", "score", "reach-share", "proximity", "--out", str(board)]
    assert cli.run(words) == 0
    with pytest.raises(InputError, match="is not this version with all of its runs"):  # the pack is a part
        leaderboard_page.main([str(board), "reach-share", "rule", "a rule"])
    pack = read_benchmark(Path(shipped_pack()))
    monkeypatch.setattr(leaderboard_page, "read_benchmark", lambda _: pack)
    monkeypatch.setattr(leaderboard_page, "FOLDER", tmp_path / "entries")
    with pytest.raises(InputError, match="Did you mean proximity"):
        leaderboard_page.main([str(board), "proximty", "rule", "a rule"])
    for method in ("proximity", "reach-share"):
        leaderboard_page.main([str(board), method, method, f"about {method}"])
    part = json.loads(board.read_text())["parts"][0]
    good = part["grids"]["methods"]["reach-share"]["good"]["value"]
    entry = json.loads((tmp_path / "entries" / "reach-share.json").read_text())
    assert part["title"] == "grids" and entry["grids"]["grids"]["good"][0] == round(100 * good, 1)
    page = leaderboard_page.page()
    assert "| reach-share | " in page and "- **proximity:** about proximity" in page
