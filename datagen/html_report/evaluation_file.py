"""Documents of `datagen evaluate --json`, checked for every field that tables and figures read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic reads typing's from Python 3.12 on

from datagen.configuration.toml_files import first_of
from datagen.schemas.errors import InputError
from datagen.schemas.untrusted_files import read_regular

_MAX_BYTES = 64 << 20
_FIX = "Write it again with `datagen evaluate --json`"

Text = Annotated[str, Field(max_length=4096)]
Share = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]
Real = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Some = Annotated[int, Field(ge=1, le=10**15)]


class _Estimate(TypedDict):
    value: Share | None
    low: Share | None
    high: Share | None


class _KnownEstimate(TypedDict):
    value: Share
    low: Share | None
    high: Share | None


class _Metres(TypedDict):
    value: Real | None
    low: Real | None
    high: Real | None


class _Difference(_Estimate):
    metric: Literal[
        "accuracy", "balanced_accuracy", "area_under_roc", "best_pick", "mean_average_precision", "good"
    ]
    first: Text
    second: Text
    verdict: Literal["above", "below", "open"]
    disjoint: bool


class _Comparison(_Difference):
    kind: Text


class _Bin(TypedDict):
    count: Some
    said: Share
    true: Share


class _Curve(TypedDict):
    x: list[Share]
    y: list[Share]


class _Curves(TypedDict):
    average_precision: Share
    roc: _Curve
    precision_recall: _Curve


class _SetMethod(TypedDict):
    accuracy: _Estimate
    balanced_accuracy: _Estimate
    area_under_roc: _KnownEstimate
    best_pick: _Estimate
    mean_average_precision: _Estimate
    accuracy_in_reach: _Estimate
    accuracy_out_of_reach: _Estimate
    brier: Share | None
    expected_calibration_error: Share | None
    reliability: list[_Bin] | None


class _Mean(TypedDict):
    name: Text
    accuracy: _Estimate
    balanced_accuracy: _Estimate
    area_under_roc: _Estimate
    best_pick: _Estimate
    mean_average_precision: _Estimate


class _ClassCounts(TypedDict):
    count: Count
    positives: Count


class _Accuracies(TypedDict):
    accuracy: Share | None


class _Group(TypedDict):
    by: Text
    group: Text
    count: Some
    positives: Count
    methods: dict[str, _Accuracies]


class _Set(TypedDict):
    candidates: Literal["in-range", "clear", "grid"]
    count: Some
    positives: Count
    scenes: Count
    in_reach: _ClassCounts
    out_of_reach: _ClassCounts
    methods: dict[str, _SetMethod]
    means: NotRequired[list[_Mean]]
    differences: list[_Difference]
    comparisons: list[_Comparison]
    curves: dict[str, _Curves]
    breakdown: list[_Group]


class _GridMethod(TypedDict):
    good: _Estimate
    missed_m: _Metres
    mean_average_precision: _Estimate


class _GridMean(_GridMethod):
    name: Text


class _Grids(TypedDict):
    scenes: Count
    scenes_without_positive: Count
    any_clear: Share | None
    methods: dict[str, _GridMethod]
    means: NotRequired[list[_GridMean]]
    differences: list[_Difference]
    comparisons: list[_Comparison]


class _Part(TypedDict):
    houses: Text
    scenes: Count
    sets: dict[str, _Set]
    left_out: dict[str, Text]
    grids: _Grids | None
    no_grids: Text | None


class _Checkpoint(TypedDict):
    place: Text
    model: Text
    sha256: Text


class _MethodRecord(TypedDict):
    name: Text
    regime: Text | None
    threshold: Real | None
    note: Text | None
    seconds_per_600: Real
    checkpoint: _Checkpoint | None


class _RunPart(TypedDict):
    label_source: Text
    split: Text
    candidates: Text
    per_scene: Count
    spec_hash: Text


class _RunRecord(TypedDict):
    place: Text
    parts: list[_RunPart]


class _Paper(TypedDict):
    source: Text
    accuracy: dict[str, Share]
    accuracy_out_of_reach: Share
    grid_selection: Share
    grid_miss_m: Real
    seconds_per_600: Real


class _Bootstrap(TypedDict):
    resamples: Count
    seed: Count
    level: Share


class _Evaluation(TypedDict):
    datagen: Text
    paper: _Paper
    runs: list[_RunRecord]
    fitted_on: list[Text]
    methods: Annotated[list[_MethodRecord], Field(min_length=1, max_length=100)]
    left_out: dict[str, Text]
    bootstrap: _Bootstrap
    parts: list[_Part]


_EVALUATION = TypeAdapter(_Evaluation)


def read_evaluation(path: Path) -> dict[str, Any]:
    """The evaluation in a file. InputError that names the first field that is missing or wrong."""
    data = read_regular(path, _MAX_BYTES, _FIX)
    try:
        report: Any = dict(_EVALUATION.validate_python(json.loads(data), strict=True))
    except ValidationError as error:
        raise first_of(error, str(path)) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", f"is not JSON ({error})", _FIX) from None
    names = {record["name"] for record in report["methods"]}
    for k, part in enumerate(report["parts"]):
        for name, scores in part["sets"].items():
            where = f"parts.{k}.sets.{name}"
            _refuse_other_methods(path, f"{where}.methods", names, scores["methods"])
            _refuse_other_methods(path, f"{where}.curves", names, scores["curves"])
            for method, numbers in scores["methods"].items():
                known = [numbers["brier"] is None, numbers["expected_calibration_error"] is None]
                if len({*known, not numbers["reliability"]}) > 1:
                    problem = "is stated without the others of its kind"
                    raise InputError(path, f"{where}.methods.{method:.80}.reliability", problem, _FIX)
            for row, group in enumerate(scores["breakdown"]):
                _refuse_other_methods(path, f"{where}.breakdown.{row}.methods", names, group["methods"])
            for method, curves in scores["curves"].items():
                for kind in ("roc", "precision_recall"):
                    if len(curves[kind]["x"]) != len(curves[kind]["y"]):
                        raise InputError(path, f"{where}.curves.{method}.{kind}", "has unequal lengths", _FIX)
        if part["grids"] is not None:
            _refuse_other_methods(path, f"parts.{k}.grids.methods", names, part["grids"]["methods"])
        elif part["no_grids"] is None:
            raise InputError(path, f"parts.{k}.no_grids", "is missing", _FIX)
    return report


def _refuse_other_methods(path: Path, field: str, names: set[str], found: dict[str, Any]) -> None:
    if missing := sorted(names - found.keys()):
        raise InputError(path, field, f"lacks the method {missing[0]!r:.80}", _FIX)
