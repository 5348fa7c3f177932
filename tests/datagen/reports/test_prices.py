"""Prices from files: the default, a user's own, and files that cannot be used."""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path

import pytest

from datagen.reports.prices import DEFAULT_PRICES, read_prices
from datagen.schemas.errors import InputError
from tests.conftest import REPOSITORY

MINE = """
currency = "EUR"
months_kept = 6
[core_hour]
price = 0.01
source = "our cluster"
date = 2026-11-01
[gpu_hour]
price = 2
source = "our cluster"
date = "2026-11-01"
[gb_month]
price = 0.5
source = "our disks"
date = "2026-11-01"
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "mine.toml"
    file.write_text(text)
    return file


def test_the_default_prices_name_their_sources_and_days() -> None:
    prices = read_prices()
    assert prices.currency == "USD"
    for price in (prices.core_hour, prices.gpu_hour, prices.gb_month):
        assert price.price > 0 and "https://" in price.source and price.date <= date(2026, 11, 22)
    assert read_prices(str(DEFAULT_PRICES)) == prices


def test_money_is_the_sum_of_hours_and_of_bytes_over_the_months_kept(tmp_path: Path) -> None:
    prices = read_prices(written(tmp_path, MINE))
    assert prices.cost_of(cpu_s=3600) == pytest.approx(0.01)
    assert prices.cost_of(gpu_s=1800) == pytest.approx(1.0)
    assert prices.cost_of(stored_bytes=2e9) == pytest.approx(2 * 0.5 * 6)
    assert prices.cost_of(3600, 1800, 2e9) == pytest.approx(7.01)
    assert prices.format(1234.5) == "1,234.50 EUR" and prices.format(0.00123) == "0.0012 EUR"
    assert prices.record()["core_hour"]["date"] == "2026-11-01"


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("price = 0.01", "price = -1", "core_hour.price"),
        ("price = 0.01", "price = nan", "core_hour.price"),
        ("price = 0.01", "price = true", "core_hour.price"),
        ("price = 0.01", 'price = "0.01"', "core_hour.price"),
        ("price = 0.01\n", "", "core_hour.price"),
        ('currency = "EUR"', 'currency = "\\u001b[31m"', "currency"),
        ('date = "2026-11-01"', 'date = "yesterday"', "gpu_hour.date"),
        ('source = "our disks"', 'source = ""', "gb_month.source"),
        ("months_kept", "months", "months"),
        ("[gb_month]", "[gb_month.more]", "gb_month"),
        ("[core_hour]", "[core_hour", "not TOML"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, old: str, new: str, field: str
) -> None:
    with pytest.raises(InputError, match=re.escape(field)) as refused:
        read_prices(written(tmp_path, MINE.replace(old, new)))
    text = str(refused.value)
    assert "mine.toml" in text and "\n" not in text and text.isprintable() and "docs/guides/costs.md" in text


def test_only_regular_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "none.toml", Path("/dev/zero"), written(tmp_path, "#" * 2_000_000)):
        with pytest.raises(InputError):
            read_prices(place)


def test_the_guides_own_file_can_be_used(tmp_path: Path) -> None:
    guide = (REPOSITORY / "docs/guides/costs.md").read_text()
    (example,) = re.findall(r"```toml\n(.*?)```", guide, re.DOTALL)
    assert read_prices(written(tmp_path, example)).months_kept == 6
