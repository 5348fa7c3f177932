"""`datagen evaluate`: compare models and baselines on simulated labels, with the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from datagen.console.command_lines import prints
from datagen.console.options import (
    AllowIncomplete,
    AsJson,
    File,
    PathsOrAddresses,
    Whole,
    refuse_odd_draws,
    refuse_output,
)
from datagen.console.printing import print_json, print_rows
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file


def print_report(report: dict[str, Any], json: bool, html: Path | None = None, **_: Any) -> int:
    """Print the tables of an evaluation."""
    if json:
        print_json(report)
        return 0
    from datagen.evaluation_report.report_tables import print_evaluation

    print_evaluation(report)
    if html is not None:
        print_rows("written", [("page", str(html))])
    return 0


@prints(print_report)
def evaluate(
    paths: Annotated[Sequence[str | Path], Parameter(name="PATH...")],
    /,
    *,
    candidates: Sequence[Literal["grid", "clear", "in-range"]] | None = None,
    fit: PathsOrAddresses | None = None,
    baselines: Sequence[str] | None = None,
    detector: File | None = None,
    heuristic: File | None = None,
    arrival: str | None = None,
    arrival_std: str | None = None,
    bootstrap: Whole = 1000,
    seed: Whole = 0,
    allow_seen_houses: bool = False,
    allow_incomplete: AllowIncomplete = False,
    allow_mixed_labels: bool = False,
    threads: Whole | None = None,
    html: File | None = None,
    json: AsJson = False,
) -> dict[str, Any]:
    """Compare models with baselines and the paper: accuracy, reach, grid selection and calibration.

    Methods are compared over candidate sets (grid: all cells; clear: where the base fits; in-range: clear and
    within the arm's reach), with intervals by resampling scenes. Files are checkpoints; folders and s3://
    addresses are runs. Runs with a house that a model was trained on are refused.

    For example: datagen evaluate model.ckpt runs/sim-test --html report.html

    Args:
        paths: Checkpoints of `datagen train`, or `released`, and runs of sim or plan labels.
        candidates: Candidate set to report; repeat for more. [default: all in the runs]
        fit: Run in validation houses to fit baselines on; repeat for more.
        baselines: Baseline to compare with, or none; repeat for more. [default: all]
        detector: Folder of a zero-shot object detector, for the detector baseline.
        heuristic: Parameters of the analytic baseline, from `datagen calibrate`.
        arrival: Arrival error to report too: normal:M[,YAW], disc:M[,YAW], nav2 or FILE.csv.
        arrival_std: The same as --arrival normal:, in metres, with yaw after a comma: 0.05,3deg.
        bootstrap: Resamples of scenes for each interval.
        seed: Seed of the resamples and example scenes.
        allow_seen_houses: Report training houses separately instead of failing.
        allow_incomplete: Accept runs that lack planned samples instead of failing.
        allow_mixed_labels: Accept labels of one source in different versions instead of failing.
        threads: CPU threads of the models. [default: chosen by torch]
        html: HTML page to write, with tables, curves and example grids.
        json: Report progress as JSON lines.

    Returns:
        Tables and curves, as `datagen evaluate --json` prints them (docs/guides/evaluate.md).

    Raises:
        InputError: A checkpoint, a run or an option cannot be used.

    Example:
        >>> report = datagen.evaluate([checkpoint, sim_run], baselines=["proximity"], bootstrap=10)
        >>> len(report["methods"]), report["candidates"]
        (2, ['in-range'])
    """
    # Imported here, so that other verbs do not wait for them and for torch.
    from datagen.evaluation_report.evaluated_runs import (
        candidate_sets_of,
        open_evaluated_runs,
        refuse_seen_houses,
        split_paths,
    )
    from datagen.evaluation_report.methods import baseline_methods, open_models, read_heuristic
    from datagen.evaluation_report.report import evaluation_report
    from datagen.evaluation_report.scoring import score_runs
    from datagen.train.arrivals import arrival_of

    fit = [str(path) for path in fit or ()]
    detector, heuristic, html = (None if p is None else Path(p) for p in (detector, heuristic, html))
    refuse_odd_draws(bootstrap, seed)
    error = arrival_of(arrival, arrival_std)
    if threads is not None and not 1 <= threads <= 1024:
        raise InputError("--threads", str(threads), "is below 1", "Give 1 or more")
    if html is not None:
        refuse_output(html, "--html", ".html", ".htm")
    checkpoints, runs = split_paths([str(path) for path in paths])
    if threads is not None:
        from datagen.train.scorers import use_threads

        use_threads(threads)
    opened = open_evaluated_runs(runs, allow_incomplete, allow_mixed_labels)
    sets = candidate_sets_of(opened, candidates or [])
    models = open_models(checkpoints)
    if not allow_seen_houses:
        refuse_seen_houses(opened, models)
    rule = read_heuristic(heuristic, opened, allow_seen_houses) if heuristic is not None else None
    baseline_set = baseline_methods(
        baselines, fit, detector, rule, seed, opened, allow_seen_houses, allow_incomplete, json
    )
    evaluated = [*baseline_set.baselines, *models]
    if not evaluated:
        fix = "Name a checkpoint, or omit --baselines"
        raise InputError("datagen evaluate", "PATH", "no model or baseline given", fix)
    gathered = score_runs(opened, evaluated, seed, json, n_examples=4)
    report = evaluation_report(gathered, baseline_set, models, opened, sets, fit, bootstrap, seed, error)
    if html is not None:
        from datagen.evaluation_report.page import page_of

        with whole_file(html, alone=True) as file:
            file.write(page_of(report, gathered).encode())
    return report
