"""`--candidates-from`: choose candidates of an existing run to label."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from datagen.configuration.specify import layout_of
from datagen.configuration.stored_scenes import StoredScenes
from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.selection import Selection
from datagen.schemas.specification import SelectionParams, Specification

if TYPE_CHECKING:
    from datagen.evaluation_report.methods import EvaluatedMethod

SelectBy = Literal["random", "margin", "uncertain", "disagree"]
# By default, 1 / _SHARE of a scene's candidates is selected.
_SHARE = 4


@dataclass(frozen=True)
class SelectOptions:
    """The options of a selection, None where not given."""

    by: SelectBy | None
    models: Sequence[str]
    per_scene: int | None
    random_share: float
    seed: int

    def refuse_bad(self, label_source: str) -> None:
        """Raise InputError for options that do not fit each other."""
        if label_source == "heuristic":
            fix = "Submit plan or sim, or label all of them with --scenes-from"
            raise InputError("--candidates-from", "", "selects candidates for dear labels", fix)
        if not 0 < self.random_share <= 1:
            problem = "is not above 0 and at most 1"
            raise InputError("--random-share", str(self.random_share), problem, "Give 0.2 for a fifth")
        method = self.by or "random"
        if method == "random" and self.models:
            fix = "Give --select margin, uncertain or disagree"
            raise InputError("--model", self.models[0], "is not used to select at random", fix)
        if method != "random" and not self.models:
            fix = "Give a checkpoint of `datagen train`"
            raise InputError("--model", "", f"is needed to select by {method}", fix)


@dataclass(frozen=True)
class SelectedCandidates:
    """Specification, layout and selection of a run of n candidates; `record` is None where the run has it."""

    spec: Specification
    layout: Layout
    n: int
    record: Selection | None


def select_candidates(
    spec: Specification, stored: StoredScenes, n: int, options: SelectOptions, out: Run | None, json: bool
) -> SelectedCandidates:
    """Select at least n candidates of a run, and return the specification of a run of them.

    The run at `out` keeps its selection where the options are those that it was made with. More than n are
    selected to fill whole scenes and shards. InputError where the run has fewer candidates.
    """
    source = stored.run
    size = source.layout.candidates_per_scene
    if source.manifest.spec.selection is not None:
        fix = "Name the run that it selected from"
        raise InputError(source.storage.url, "selection", "has selected candidates alone", fix)
    per_scene = options.per_scene or max(1, size // _SHARE)
    if per_scene > size:
        problem = f"is more than the {size} candidates of a scene"
        raise InputError("--candidates-per-scene", str(per_scene), problem, f"Give {size} or fewer")
    methods = _open(options.models)
    by: SelectBy = options.by or "random"
    chosen = {
        "method": by,
        "per_scene": per_scene,
        "random_share": 1.0 if by == "random" else options.random_share,
        "seed": options.seed,
        "models": tuple(method.head.digest for method in methods if method.head is not None),
    }
    before = None if out is None else out.manifest.spec.selection
    if out is not None and before is not None:
        existing = before.model_dump(include=set(chosen))
        if existing == chosen and n <= out.n:
            return SelectedCandidates(_with(spec, before), out.layout, out.n, None)
        if existing == chosen:
            problem = f"is more than the {out.n:,} candidates that {out.storage.url} selected"
            raise InputError("--n", str(n), problem, "Select others into another --out")
    available = min(stored.available() // size, source.n // size)
    layout = _layout(spec, -(-n // per_scene), per_scene, available)
    scenes = layout.shards_for(n) * layout.scenes_per_shard
    if scenes > available:
        has = f"{source.storage.url} has {available:,}"
        problem = f"needs {scenes:,} scenes of {per_scene} candidates, but {has}"
        raise InputError("--n", str(n), problem, "Ask for fewer labels, or for more --candidates-per-scene")
    selection = _select(stored, available, scenes, per_scene, by, options, methods, json)
    params = SelectionParams.model_validate(chosen | {"scenes": available, "sha256": selection.digest()})
    return SelectedCandidates(_with(spec, params), layout, scenes * per_scene, selection)


def _with(spec: Specification, selection: SelectionParams) -> Specification:
    return spec.model_copy(update={"selection": selection})


def _layout(spec: Specification, scenes: int, per_scene: int, available: int) -> Layout:
    """Shards of about as many scenes as `layout_of` has, which the selected scenes fill."""
    most = min(layout_of(spec, scenes * spec.candidates.count).scenes_per_shard, scenes)
    fitting = [k for k in range(most, most // 2, -1) if -(-scenes // k) * k <= available]
    best = min(fitting, key=lambda k: (-(-scenes // k) * k, -k), default=1)
    return Layout(scenes_per_shard=best, candidates_per_scene=per_scene)


def _open(models: Sequence[str]) -> list[EvaluatedMethod]:
    if not models:
        return []
    files: list[str] = []
    for model in models:
        if not (file := checkpoint_file(model)):
            fix = "Give a checkpoint of `datagen train`, or released"
            raise InputError("--model", model, "no such file", fix)
        files.append(file)
    from datagen.evaluation_report.methods import open_models

    return open_models(files)


def _select(
    stored: StoredScenes,
    available: int,
    scenes: int,
    per_scene: int,
    by: SelectBy,
    options: SelectOptions,
    methods: Sequence[EvaluatedMethod],
    json: bool,
) -> Selection:
    # Imported here: only a selection needs the code that reads and scores labels.
    from datagen.estimation.two_stage_sampling import all_alike, draw_sample
    from datagen.estimation.unsureness import design_by, read_unsure

    rng = generator(options.seed, Stream.SELECTION)
    size = stored.candidates_per_scene
    if by == "random":
        design = all_alike(available, size, scenes, per_scene)
    else:
        unsure = read_unsure(stored.run, available, by, methods, json)
        design = design_by(by, unsure, scenes, per_scene, rng)
    share = 1.0 if by == "random" else options.random_share
    sample = draw_sample(design, scenes, per_scene, share, rng)
    return Selection(
        scenes=tuple(sample.scene.tolist()),
        candidates=tuple(map(tuple, sample.candidate.tolist())),
        probability=tuple(map(tuple, sample.probability.tolist())),
    )
