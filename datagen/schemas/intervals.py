"""Types of a specification's values: sections, lengths, corners, and intervals from which one is sampled."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Metres = Annotated[float, Field(ge=0.0, le=100.0, allow_inf_nan=False)]
Offset = Annotated[float, Field(ge=-20.0, le=20.0, allow_inf_nan=False)]
Corner = Annotated[tuple[Offset, Offset], Field(strict=False)]
Angle = Annotated[float, Field(ge=-3.14159266, le=3.14159266)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Frozen(BaseModel):
    """A section: strict, and without NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _Ordered(Frozen):
    low: float
    high: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.high < self.low:
            raise ValueError(f"high {self.high} is below low {self.low}")
        return self


class Range(_Ordered):
    """A closed interval in metres, from which a length is sampled uniformly."""

    low: Metres
    high: Metres


class Turns(_Ordered):
    """A closed interval of angles (rad), counter-clockwise, from which one is sampled uniformly."""

    low: Angle
    high: Angle


class Interval(Range):
    """A closed interval, without unit, from which a number is sampled uniformly."""
