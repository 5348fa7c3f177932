"""`datagen evaluate`: models and baselines held against simulated labels, beside the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from datagen.console.options import AllowIncomplete, AsJson, refuse_odd_draws, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.schemas.errors import InputError
from datagen.schemas.progress import counting
from datagen.schemas.whole_files import whole_file


def verb(
    places: Annotated[
        list[str],
        Parameter(negative=(), help="Checkpoints of `datagen train`, and runs of sim (or plan) labels."),
    ],
    *,
    candidates: Annotated[
        list[Literal["grid", "clear", "in-range"]] | None,
        Parameter(negative=(), help="A set of candidates to tell of; repeat it for more [all in the runs]."),
    ] = None,
    fit: Annotated[
        list[str] | None,
        Parameter(negative=(), help="A run in validation houses, to fit baselines on; repeat it for more."),
    ] = None,
    baselines: Annotated[
        list[str] | None,
        Parameter(negative=(), help="A baseline beside the models, or none; repeat it for more [all]."),
    ] = None,
    detector: Annotated[
        Path | None, Parameter(help="Folder of a zero-shot object detector, for the baseline with one.")
    ] = None,
    heuristic: Annotated[
        Path | None,
        Parameter(help="Parameters of the analytic baseline, as `datagen calibrate` writes them."),
    ] = None,
    bootstrap: Annotated[
        int, WHOLE_NUMBER, Parameter(help="Resamples of scenes behind each interval.")
    ] = 1000,
    seed: Annotated[int, WHOLE_NUMBER, Parameter(help="Seed of resamples and of the scenes shown.")] = 0,
    allow_seen_houses: Annotated[
        bool, Parameter(negative=(), help="Tell apart of houses that were trained on, instead of refusing.")
    ] = False,
    allow_incomplete: AllowIncomplete = False,
    threads: Annotated[
        int | None, WHOLE_NUMBER, Parameter(help="Threads that models compute on [torch's choice].")
    ] = None,
    html: Annotated[Path | None, Parameter(help="Write a page with tables, curves and grids.")] = None,
    json: AsJson = False,
) -> int:
    """How good models are, beside baselines and the paper: accuracy, reach, grid selection, calibration.

    Methods are compared over named sets of candidates (grid: all cells; clear: where the base fits; in-range:
    those within the arm's reach too), with intervals by resampling scenes. Files are checkpoints, folders
    and s3:// addresses runs. A house that a model was trained on is refused.
    """
    report = evaluate(
        places,
        candidates=candidates,
        fit=fit,
        baselines=baselines,
        detector=detector,
        heuristic=heuristic,
        bootstrap=bootstrap,
        seed=seed,
        allow_seen_houses=allow_seen_houses,
        allow_incomplete=allow_incomplete,
        threads=threads,
        html=html,
        json=json,
    )
    if json:
        print_json(report)
        return 0
    from datagen.evaluating.tables import print_evaluation

    print_evaluation(report)
    if html is not None:
        print_rows("written", [("page", str(html))])
    return 0


def evaluate(
    paths: Sequence[str | Path],
    *,
    candidates: Sequence[Literal["grid", "clear", "in-range"]] | None = None,
    fit: Sequence[str | Path] | None = None,
    baselines: Sequence[str] | None = None,
    detector: str | Path | None = None,
    heuristic: str | Path | None = None,
    bootstrap: int = 1000,
    seed: int = 0,
    allow_seen_houses: bool = False,
    allow_incomplete: bool = False,
    threads: int | None = None,
    html: str | Path | None = None,
    json: bool = False,
) -> dict[str, Any]:
    """Compare models and baselines with simulated labels; return tables and curves as plain values.

    The result is what `datagen evaluate --json` prints; docs/evaluation.md describes it.

    Args:
        paths: Checkpoints of `train_model`, and runs of sim (or plan) labels.
        candidates: Candidate sets to report [all in the runs].
        fit: Runs in validation houses, to fit baselines on.
        baselines: Names of baselines, or ["none"] [all].
        detector: Folder of a zero-shot object detector, for the baseline with one.
        heuristic: Parameters of the analytic baseline, as `datagen calibrate` writes them.
        bootstrap: Resamples of scenes behind each interval.
        seed: Seed of resamples and of the scenes shown.
        allow_seen_houses: Report training houses separately instead of failing.
        allow_incomplete: Read runs that lack a part of their labels.
        threads: Threads that models compute on.
        html: Page to write, with tables, curves and grids.
        json: Report progress as JSON lines.

    Raises:
        InputError: A checkpoint, a run or an option cannot be used.

    Example:
        >>> report = datagen.evaluate([checkpoint, sim_run], baselines=["proximity"], bootstrap=10)
        >>> len(report["methods"]), report["candidates"]
        (2, ['in-range'])
    """
    # Imported here: other verbs wait neither for these nor for torch.
    import numpy as np

    from datagen.evaluating.contestants import open_models
    from datagen.evaluating.lineup import line_up, read_heuristic
    from datagen.evaluating.places import open_places, refuse_seen_houses, sets_of, tell_apart
    from datagen.evaluating.report import evaluation_report
    from datagen.train.evaluation.columns import gather

    fit = [str(path) for path in fit or ()]
    detector, heuristic, html = (None if p is None else Path(p) for p in (detector, heuristic, html))
    _refuse_odd(bootstrap, seed, threads, html)
    checkpoints, runs = tell_apart([str(path) for path in paths])
    if threads is not None:
        from datagen.train.scorers import use_threads

        use_threads(threads)
    opened = open_places(runs, allow_incomplete)
    sets = sets_of(opened, candidates or [])
    models = open_models(checkpoints)
    if not allow_seen_houses:
        refuse_seen_houses(opened, models)
    rule = read_heuristic(heuristic, opened, allow_seen_houses) if heuristic is not None else None
    lineup = line_up(
        baselines,
        fit,
        detector,
        rule,
        seed,
        opened,
        allow_seen_houses,
        allow_incomplete,
        json,
    )
    contestants = [*lineup.baselines, *models]
    if not contestants:
        mend = "Name a checkpoint, or leave --baselines out"
        raise InputError("datagen evaluate", "CKPT", "there is nobody to evaluate", mend)
    with counting("scenes", json) as seen:
        total, done = sum(place.stream.n_scenes for place in opened), 0

        def step(scenes: int) -> None:
            nonlocal done
            done += scenes
            seen(done, total)

        batches = [(place.cells, place.stream.epoch(0)) for place in opened]
        rng = np.random.default_rng([seed, 0])
        gathered = gather(batches, {c.name: c.scorer for c in contestants}, rng, seen=step)
    houses = lineup.houses.union(*(model.houses for model in models))
    report = evaluation_report(
        gathered,
        contestants,
        opened,
        sets,
        seen_houses=houses,
        fit=fit,
        left_out=lineup.left_out,
        resamples=bootstrap,
        seed=seed,
    )
    if html is not None:
        from datagen.evaluating.page import page_of

        with whole_file(html, alone=True) as file:
            file.write(page_of(report, gathered).encode())
    return report


def _refuse_odd(bootstrap: int, seed: int, threads: int | None, html: Path | None) -> None:
    refuse_odd_draws(bootstrap, seed)
    if threads is not None and not 1 <= threads <= 1024:
        raise InputError("--threads", str(threads), "not a usable number of threads", "Give 1 or more")
    if html is not None:
        refuse_output(html, "--html", ".html", ".htm")
