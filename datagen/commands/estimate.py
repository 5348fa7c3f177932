"""`datagen estimate`: success rates from many cheap and few dear labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from datagen.console.command_lines import prints
from datagen.console.options import AsJson
from datagen.console.printing import print_json
from datagen.schemas.errors import InputError


def print_estimates(report: dict[str, Any], json: bool, **_: Any) -> int:
    """Print the rates, and the cost of further labels."""
    if json:
        print_json(report)
        return 0
    from datagen.estimation.estimate_tables import print_estimation

    print_estimation(report)
    return 0


@prints(print_estimates)
def estimate(
    runs: Annotated[Sequence[str], Parameter(name="CHEAP...")],
    /,
    *,
    dear: Annotated[Sequence[str], Parameter(name="--with", consume_multiple=True)],
    methods: Annotated[Sequence[str] | None, Parameter(consume_multiple=True)] = None,
    candidates: Sequence[Literal["grid", "clear", "in-range"]] | None = None,
    half_width: float | None = None,
    json: AsJson = False,
) -> dict[str, Any]:
    """Estimate success rates from many cheap and few dear labels of the same candidates.

    The rate of the dear labels is corrected by how far the cheap labels of the same candidates lie from
    those of the whole population (prediction-powered inference). Scenes are the units. Dear labels of
    selected candidates (submit --select) count 1/probability. Models help as further cheap labels.

    For example: datagen estimate runs/heuristic --with runs/plan --half-width 0.02

    Args:
        runs: Runs of cheaper labels over the whole population.
        dear: Runs of the label source that is taken as the truth, over some of these candidates.
        methods: Checkpoints, released or baselines to estimate the picks of: robots' best clear candidates.
        candidates: Candidate sets to report; grid: all [all that the runs cover].
        half_width: Half width of the wanted interval, such as 0.02; shows the further labels that it needs.

    Returns:
        The estimates, as `datagen estimate --json` prints them (docs/guides/estimate.md).
    """
    if not runs:
        raise InputError("datagen estimate", "CHEAP", "is missing", "Name one or more run folders")
    if half_width is not None and not 0 < half_width < 0.5:
        raise InputError("--half-width", str(half_width), "is not between 0 and 0.5", "Give 0.02 for 2%")
    # Imported here, so that other verbs do not wait for them.
    from datagen.estimation.mixed_labels import read_mixed
    from datagen.estimation.report import estimation_report

    labels, scores = read_mixed(runs, dear), []
    sets = candidates or labels.sets
    for name in sets:
        if name not in labels.sets:
            problem = f"the runs cover {labels.sets[0]} candidates alone"
            raise InputError("--candidates", name, problem, f"Choose one of: {', '.join(labels.sets)}")
    if methods:
        from datagen.estimation.picks import open_methods, score_population, with_models

        scores = score_population(labels, open_methods(methods), json)
        labels = with_models(labels, scores)
    return estimation_report(labels, sets, scores, half_width)
