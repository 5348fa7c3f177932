"""Prices of core-hours, GPU-hours and stored bytes, read from a TOML file."""

from __future__ import annotations

from datetime import date as Day
from math import floor, log10
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from datagen.configuration.toml_files import read_toml
from datagen.schemas.errors import InputError

DEFAULT_PRICES = Path(__file__).with_name("prices.toml")
_FIX = "Give a TOML file as in docs/guides/costs.md"
_HOUR_S = 3600.0
_GB = 1e9

Amount = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False, strict=True)]
# TOML has dates of its own, and people also write them as text.
IsoDay = Annotated[Day, BeforeValidator(lambda day: Day.fromisoformat(day) if isinstance(day, str) else day)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Price(_Section):
    """A price per unit, its source, and the day on which the source was read."""

    price: Amount
    source: Annotated[str, Field(min_length=1, max_length=1000, strict=True)]
    date: IsoDay


class Prices(_Section):
    """Prices in one currency. Money of a run: core-hours, GPU-hours, and GB stored for `months_kept`."""

    currency: Annotated[str, Field(pattern=r"^[A-Z]{3}$", strict=True)]
    months_kept: Annotated[float, Field(ge=0, le=1200, allow_inf_nan=False, strict=True)] = 1.0
    core_hour: Price
    gpu_hour: Price
    gb_month: Price

    def cost_of(self, cpu_s: float = 0.0, gpu_s: float = 0.0, stored_bytes: float = 0.0) -> float:
        """Money for CPU seconds (of one logical core), GPU seconds, and bytes stored for `months_kept`."""
        return (
            self.core_hour.price * cpu_s / _HOUR_S
            + self.gpu_hour.price * gpu_s / _HOUR_S
            + self.gb_month.price * self.months_kept * stored_bytes / _GB
        )

    def format(self, money: float) -> str:
        """An amount with its currency: 12.30 USD; below 0.1 with two significant digits: 0.0042 USD."""
        digits = 2 if money >= 0.1 or money <= 0 else 1 - floor(log10(money))
        return f"{money:,.{digits}f} {self.currency}"

    def record(self) -> dict[str, Any]:
        """Plain values for JSON; dates as YYYY-MM-DD."""
        return self.model_dump(mode="json")


def read_prices(path: str | Path | None = None) -> Prices:
    """Read prices from a TOML file; None: the defaults, `DEFAULT_PRICES`, which name their sources.

    Raises InputError for a file that cannot be read, is not TOML, lacks a price or has an odd value.
    """
    file = DEFAULT_PRICES if path is None else Path(path)
    try:
        return Prices.model_validate(read_toml(file, _FIX))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise InputError(file, field, f"{first['msg']} (given: {str(first['input'])[:80]})", _FIX) from None
