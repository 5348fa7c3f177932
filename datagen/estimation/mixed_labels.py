"""Labels of cheap and dear runs over the same candidates, joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.estimation.cross_fitting import cross_fitted
from datagen.estimation.rates import Population
from datagen.reports.specification_summary import is_disturbed
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_committed
from datagen.schemas.specification import Specification
from datagen.train.inputs import F64, I64, Bools
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS, in_set

Array = npt.NDArray[Any]

_KEYS = ("sample_scene_index", "candidate_index")
# Numbers of a candidate that help to predict its label.
NUMBERS = (
    *("heuristic_score", "visibility", "distance_m", "mount_distance_m"),
    *("arm_reach_m", "base_height_m", "base_clearance_m"),
)
_CHEAP = (*_KEYS, "sample_id", "robot_index", "label", "base_is_clear", *NUMBERS)
_OF_RANGE = ("mount_distance_m", "arm_reach_m")
# A scene has fewer than 2^32 candidates.
_CANDIDATES = 2**32


@dataclass(frozen=True, eq=False)
class MixedLabels:
    """N candidates of M scenes with the labels of P cheap sources, and dear ones of some. Arrays are (N,)."""

    cheap_names: tuple[str, ...]  # (P,)
    dear_name: str
    cheap_runs: tuple[Run, ...]
    dear_runs: tuple[Run, ...]
    is_selected: bool  # whether the dear labels are of selected candidates
    population: Population
    sample_id: npt.NDArray[np.void]  # of the first cheap source
    robot: I64  # numbered from 0 through all scenes
    is_clear: Bools
    numbers: F64  # (N, 7), in the order of NUMBERS

    @property
    def sets(self) -> tuple[str, ...]:
        """The candidate sets that the cheap runs cover, widest first."""
        widths = {None: 0, "clear": 1, "in-range": 2}
        first = max(widths[run.manifest.spec.candidates.within] for run in self.cheap_runs)
        return tuple(reversed(CANDIDATE_SETS))[first:]

    def runs_of(self, name: str) -> list[Run]:
        """The runs of one cheap source."""
        return [run for run in self.cheap_runs if source_name(run.manifest.spec) == name]

    def member(self, candidates: str) -> F64:
        """1 for candidates in a set of CANDIDATE_SETS, else 0."""
        mount_distance_m, reach_m = (self.numbers[:, NUMBERS.index(n)] for n in _OF_RANGE)
        return in_set(candidates, self.is_clear, mount_distance_m, reach_m).astype(np.float64)

    def fitted(self) -> MixedLabels:
        """These labels with one cheap column: a prediction from the cheap labels and NUMBERS.

        Unchanged where too few scenes have dear labels for it.
        """
        features = np.column_stack([self.population.cheap, self.numbers])
        prediction = cross_fitted(self.population, features, self.is_clear)
        if prediction is None:
            return self
        population = replace(self.population, cheap=prediction[:, None])
        return replace(self, cheap_names=("fitted",), population=population)


def source_name(spec: Specification) -> str:
    """The label source of a specification, as estimates name it."""
    return f"{spec.label_source}, disturbed" if is_disturbed(spec) else spec.label_source


def read_mixed(cheap: Sequence[str], dear: Sequence[str]) -> MixedLabels:
    """Join the labels of the runs at these paths.

    The population has every candidate that all cheap sources labelled, in whole scenes within the runs' n.
    InputError where runs are not over the same candidates, or a source labelled them twice.
    """
    cheap_runs = [run for path in cheap for run in open_runs(path)]
    dear_runs = [run for path in dear for run in open_runs(path)]
    names = tuple(dict.fromkeys(source_name(run.manifest.spec) for run in cheap_runs))
    dear_names = list(dict.fromkeys(source_name(run.manifest.spec) for run in dear_runs))
    if len(dear_names) > 1:
        problem = f"labels of {dear_names[0]} and of {dear_names[1]} are not of one truth"
        raise InputError("--with", dear[-1], problem, "Name runs of one label source")
    if dear_names[0] in names:
        problem = f"has {dear_names[0]} labels, as the runs of --with have"
        raise InputError(cheap[names.index(dear_names[0])], "label_source", problem, "Name cheaper labels")
    by_scenes: dict[str, dict[str, Run]] = {}
    for run in (*cheap_runs, *dear_runs):
        spec = run.manifest.spec
        of_scenes = by_scenes.setdefault(spec.scenes_hash, {})
        other = of_scenes.setdefault(source_name(spec), run)
        if other is not run:
            problem = f"has {source_name(spec)} labels of the scenes of {other.storage.url}"
            raise InputError(run.storage.url, "scenes", problem, "Name one of the two")
    blocks = [_join(of_scenes, names, dear_names[0]) for of_scenes in by_scenes.values()]
    columns = _stacked(blocks)
    return MixedLabels(
        cheap_names=names,
        dear_name=dear_names[0],
        cheap_runs=tuple(cheap_runs),
        dear_runs=tuple(dear_runs),
        is_selected=any(_is_selected(run) for run in dear_runs),
        population=Population(
            n_scenes=int(columns["scene"].max()) + 1,
            **{name: columns[name] for name in ("scene", "cheap", "is_dear", "label", "probability")},
        ),
        sample_id=np.ascontiguousarray(columns["sample_id"]).view("V16").ravel(),
        robot=columns["robot"],
        is_clear=columns["base_is_clear"],
        numbers=columns["numbers"],
    )


def _join(of_scenes: dict[str, Run], names: Sequence[str], dear_name: str) -> dict[str, Array]:
    """The joined columns of one set of scenes; scenes and robots are numbered from 0."""
    for name in (*names, dear_name):
        if name not in of_scenes:
            url = next(iter(of_scenes.values())).storage.url
            problem = f"no run here has {name} labels of its candidates"
            fix = "Make them with `datagen submit ... --scenes-from`, or omit the run"
            raise InputError(url, "scenes", problem, fix)
    tables = [read_whole_scenes(of_scenes[name], _CHEAP) for name in names]
    dear_run = of_scenes[dear_name]
    selection = ("selection_probability",) if _is_selected(dear_run) else ()
    dear = read_whole_scenes(dear_run, (*_KEYS, "label", *selection))
    keys = tables[0]["key"]
    for table in tables[1:]:
        keys = np.intersect1d(keys, table["key"], assume_unique=True)
    rows = [np.searchsorted(table["key"], keys) for table in tables]
    first = {name: values[rows[0]] for name, values in tables[0].items()}
    scenes, scene = np.unique(keys // _CANDIDATES, return_inverse=True)
    position = np.searchsorted(keys, dear["key"])
    position[position == len(keys)] = 0
    known = keys[position] == dear["key"]
    if not known.any():
        url, other = dear_run.storage.url, of_scenes[names[0]].storage.url
        problem = f"none of its candidates is in {other}"
        raise InputError(url, "candidate_index", problem, "Make more labels of the cheap run")
    probability = np.ones(len(keys))
    if selection:
        probability[position[known]] = dear["selection_probability"][known]
    else:
        # Scenes of a run are independent and identically distributed: the first ones are a random sample.
        probability[:] = len(np.unique(scene[position[known]])) / len(scenes)
    is_dear, label = np.zeros(len(keys), np.bool_), np.zeros(len(keys), np.bool_)
    is_dear[position[known]] = True
    label[position[known]] = dear["label"][known] == 1
    _, robot = np.unique(scene * _CANDIDATES + first["robot_index"], return_inverse=True)
    return {
        "sample_id": first["sample_id"],
        "base_is_clear": first["base_is_clear"],
        # As stored: these numbers decide whether a candidate at the edge of the reach is within it.
        "numbers": np.stack([first[name] for name in NUMBERS], axis=1).astype(np.float64),
        "cheap": np.stack([t["label"][at] for t, at in zip(tables, rows, strict=True)], 1).astype(np.float64),
        "scene": scene.astype(np.int64),
        "robot": robot.astype(np.int64),
        "is_dear": is_dear,
        "label": label,
        "probability": probability,
    }


def _stacked(blocks: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """The blocks one after the other, with scenes and robots numbered consecutively."""
    for numbered in ("scene", "robot"):
        first = 0
        for block in blocks:
            block[numbered] = block[numbered] + first
            first = int(block[numbered].max()) + 1
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _is_selected(run: Run) -> bool:
    return any(f.name == "selection_probability" for f in run.schema.sample_fields)


def read_whole_scenes(run: Run, names: Sequence[str]) -> dict[str, Array]:
    """Columns of the committed whole scenes within n, with a `key` of scene and candidate, ascending.

    InputError for a damaged file, and for a run without such a scene.
    """
    per_scene = run.layout.candidates_per_scene
    parts: list[dict[str, Array]] = []
    for shard in sorted(run.committed()):
        rows = run.layout.rows_wanted(shard, run.n)[1] // per_scene * per_scene
        if rows:
            read = read_committed(run.storage, run.commit_of(shard), names)
            parts.append({name: values[:rows] for name, values in read.items()})
    if not parts:
        problem = "no whole scene is committed"
        raise InputError(run.storage.url, "commits", problem, "Make its labels with `datagen resume`")
    columns = {name: np.concatenate([part[name] for part in parts]) for name in names}
    key = columns["sample_scene_index"] * _CANDIDATES + columns["candidate_index"]
    order = np.argsort(key)
    return {"key": key[order], **{name: values[order] for name, values in columns.items()}}
