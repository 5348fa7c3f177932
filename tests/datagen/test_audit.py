"""`datagen audit`: its files, its refusals, and what a person reads first."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from PIL import Image

from datagen import cli
from datagen.reports.prices import DEFAULT_PRICES
from datagen.schemas.run import Run
from datagen.schemas.specification import ScenesFrom
from tests.made_runs import make_run, small_spec
from tests.refusals import refused
from tests.small_runs import json_of


@pytest.fixture(scope="module")
def paired(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two runs with labels of the same candidates. Tests only read them."""
    folder = tmp_path_factory.mktemp("paired")
    first = make_run(folder / "first", n=200)
    scenes = ScenesFrom(spec_hash=first.manifest.spec_hash)
    second = make_run(folder / "second", n=200, spec=small_spec(seed=1, scenes_from=scenes))
    return [first.storage.url, second.storage.url]


@pytest.mark.parametrize("name", ["map.png", "map.svg"])
def test_a_map_of_wrong_labels_is_drawn(
    name: str, paired: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / name
    assert cli.run(["audit", *paired, "--map", str(out)]) == 0
    assert str(out) in capsys.readouterr().out
    if name.endswith("png"):
        with Image.open(out) as image:
            assert image.width > 1000 and image.height > 300
    else:
        assert ElementTree.parse(out).getroot().tag.endswith("svg")
    again = tmp_path / f"again-{name}"
    assert cli.run(["audit", *paired, "--map", str(again)]) == 0
    assert again.read_bytes() == out.read_bytes()


def test_a_map_needs_a_pair_of_runs_and_a_name_of_a_picture(
    paired: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(["audit", paired[0], "--map", str(tmp_path / "map.png")], capsys, "--map", "same candidates")
    refused(["audit", *paired, "--map", str(tmp_path / "map.pdf")], capsys, ".svg or .png")
    refused(["audit", *paired, "--map", str(tmp_path / "none" / "map.png")], capsys, "its folder")


def test_prices_of_a_file_are_used_and_recorded(
    paired: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine.toml"
    text = DEFAULT_PRICES.read_text().replace('"USD"', '"EUR"').replace("price = 0.0425", "price = 0.425")
    mine.write_text(text)
    usual, given = (json_of(capsys, ["audit", *paired, *more]) for more in ([], ["--prices", str(mine)]))
    assert given["prices"]["currency"] == "EUR" and given["prices"]["core_hour"]["source"]
    money = [report["sources"][0]["cost_per"]["label"]["money"] for report in (usual, given)]
    assert money[1] == pytest.approx(10 * money[0])  # these runs store no bytes
    assert cli.run(["audit", *paired, "--prices", str(mine)]) == 0
    assert "EUR" in capsys.readouterr().out
    mine.write_text(text.replace("price = 0.425", "price = -1"))
    refused(["audit", *paired, "--prices", str(mine)], capsys, "mine.toml", "core_hour.price", "costs.md")


def test_costs_and_agreement_come_before_details(
    paired: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["audit", *paired]) == 0
    told = capsys.readouterr().out
    heads = [
        "cost in core time", "money", "180,000 labels", "sums", "agreement with", "audit of", "first against",
    ]  # fmt: skip
    places = [told.index(f"\n{head}" if k else head) for k, head in enumerate(heads)]
    assert places == sorted(places)
    assert told.startswith("cost in core time") and Run.open(paired[1]).storage.url in told
