"""The methods that a leaderboard compares: checkpoints, baselines, Python scorers and files of scores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from datagen.benchmark.python_scorers import REFERENCE, import_scorer
from datagen.benchmark.score_files import read_scores
from datagen.display.progress import Progress
from datagen.evaluation_report.evaluated_runs import EvaluatedRun
from datagen.evaluation_report.methods import EvaluatedMethod, baseline_methods, open_models
from datagen.released import RELEASED, released_checkpoint
from datagen.schemas.errors import InputError
from datagen.train.baselines import BASELINES

_RUNS = "runs the code of"


def open_methods(
    named: Sequence[str], fit: Sequence[str], seed: int, runs: Sequence[EvaluatedRun], json: bool
) -> list[EvaluatedMethod]:
    """The methods, in the order in which they are named.

    InputError for an unknown method, for two methods of one name, and where `fit` and `runs` share a house.
    """
    kinds = {each: _kind(each) for each in named}
    checkpoints = [each for each, kind in kinds.items() if kind == "checkpoint"]
    paths = [str(released_checkpoint()) if each == RELEASED else each for each in checkpoints]
    found = {
        each: replace(model, name=each if each == RELEASED else Path(each).stem)
        for each, model in zip(checkpoints, open_models(paths), strict=True)
    }
    baselines = [each for each, kind in kinds.items() if kind == "baseline"]
    if baselines:
        made = baseline_methods(baselines, fit, None, None, seed, runs, False, json=json)
        found |= dict(zip(baselines, made.baselines, strict=True))
    for each, kind in kinds.items():
        if kind == "scores":
            file = read_scores(Path(each))
            found[each] = EvaluatedMethod(
                file.name,
                file,
                file.path,
                note="scores of a file",
                gives_probabilities=file.gives_probabilities,
            )
        elif kind == "python":
            Progress(json).say("note", {"note": f"{_RUNS} {each}"}, f"{_RUNS} {each}")
            scorer = import_scorer(each)
            found[each] = EvaluatedMethod(
                each, scorer, each, note=f"{_RUNS} {each}", gives_probabilities=scorer.gives_probabilities
            )
    methods = [found[each] for each in kinds]
    for name, count in Counter(method.name for method in methods).items():
        if count > 1:
            raise InputError("METHOD", name, "is the name of two methods", "Rename one of the files")
    return methods


def _kind(named: str) -> str:
    path = Path(named)
    if named == RELEASED:
        return "checkpoint"
    if named in BASELINES:
        return "baseline"
    if path.is_file():
        return "scores" if path.suffix.lower() == ".csv" else "checkpoint"
    if REFERENCE.fullmatch(named):
        return "python"
    fix = (
        f"Give {RELEASED}, a checkpoint, a file of scores (.csv), module:function, "
        f"or a baseline: {', '.join(BASELINES)}"
    )
    raise InputError("METHOD", named, "is no file and no baseline", fix)


def refuse_trained_objects(
    path: str, run: EvaluatedRun, methods: Sequence[EvaluatedMethod], held_out: bool
) -> None:
    """Raise InputError for a model that was trained on an object of a run whose objects are held out."""
    if not held_out:
        return
    here = run.stream.object_digests()
    for method in methods:
        if shared := here & method.objects:
            problem = (
                f"{method.name} was trained on {len(shared)} of the {len(here)} objects that it holds out"
            )
            raise InputError(path, "object_digest", problem, "Train on OUT/objects/train of `benchmark make`")
