r"""The value of selected labels at equal CPU seconds: `submit --select` against random and new scenes.

    datagen submit plan --n 100000 --candidates in-range --candidates-per-scene 30 ... --out TRAIN
    datagen submit heuristic --robot panda-scaled --candidates in-range ... --out POOL
    datagen submit plan --candidates-from POOL --n 1050 ... --out SELECTED
    python -m benchmarks.selection TRAIN --selected SELECTED --val VAL --test TEST --out FOLDER \
        --houses procthor:DIR --objects ycb:DIR

TRAIN is the pool of candidates whose labels can be bought. For each seed, a model is trained on
--first labelled scenes, and each way buys labels for --budget CPU seconds:

- uniform: random scenes of the pool, and random candidates in each
- margin, uncertain, disagree: as `submit --select`, with its random share. They pay for training the first
  model and for scoring the pool
- uniform, as many labels: uniform for the seconds that the others have left for labels
- new scenes: scenes that are made for it, with all their candidates, as `datagen frontier` advises

Seconds of a purchase are those of making its scenes, new or again, and of planning its candidates, by
outcome (`selection_costs.py`). A model is then trained on the first and the bought labels, with the same
number of labels shown and of steps for every way, and judged on TEST. Intervals are over seeds and scenes;
differences are paired by seed. Finished trainings in FOLDER are used again.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch

from benchmarks.selection_costs import Costs, kinds_of, measured_costs
from datagen.display.progress import counting
from datagen.estimation.mixed_labels import read_whole_scenes
from datagen.estimation.two_stage_sampling import all_alike, draw_sample
from datagen.estimation.unsureness import By, design_by, unsureness
from datagen.frontier.mixtures import MODEL_CONFIG
from datagen.frontier.points import METRICS, TestSet, measured
from datagen.schemas.identity import digest_of
from datagen.schemas.run import Run
from datagen.schemas.whole_files import whole_file
from datagen.train.encoded.batches import EncodedBatches
from datagen.train.encoded.runs import EncodedRuns, encode_runs, encoded_stream
from datagen.train.encoded.training import Trained, scores_of, train_encoded
from datagen.train.evaluation.bootstrap import Estimate, resample_weights
from datagen.train.evaluation.seeds import mean_over_seeds
from datagen.train.inputs import F32, F64, I64, Array, Bools
from datagen.train.models.shared import SharedModel
from datagen.train.training.options import STAGES, Options

_RANDOM_SHARE, _RESAMPLES = 0.2, 500
_DECISIVE = ("first", "pool", "per_scene", "budget", "shown", "steps")

Way = Literal["uniform", "new scenes", "uniform, as many labels", "margin", "uncertain", "disagree"]
WAYS: tuple[Way, ...] = get_args(Way)


@dataclass(frozen=True, eq=False)
class Data:
    """TRAIN with S scenes of K candidates each, the runs to validate and test on, and the costs."""

    train: EncodedRuns
    kind: Array  # (S, K) of the outcome, row in KINDS
    cheap: Array  # (S, K) label of the default rule
    val: EncodedRuns
    test: EncodedRuns
    costs: Costs


@dataclass(frozen=True, eq=False)
class Purchase:
    """The bought candidates (S, K), and CPU seconds before the first label and of the labels."""

    chosen: Bools
    before_s: float
    labels_s: float


@dataclass(frozen=True, eq=False)
class Result:
    """The labels that one way bought, and the scores of its model."""

    numbers: F64  # (5,): labels, scenes, share of good labels, seconds before the first label, and of labels
    scores: F32  # (T,) of the test candidates within reach


def main() -> None:
    """Print the tables."""
    given = _options()
    torch.set_num_threads(1)
    out = Path(given.out)
    model = SharedModel(MODEL_CONFIG)
    runs: dict[str, EncodedRuns] = {}
    for name in ("train", "val", "test"):
        with counting(f"scenes of {name} encoded", False) as seen:
            stream = encoded_stream([vars(given)[name]], False)
            runs[name] = encode_runs(stream, model, out / "encodings", seen)
    train = Run.open(given.train)
    sources = given.houses, given.objects
    costs = measured_costs(
        train, Run.open(given.selected), *sources, given.timed, model, out / "selection-costs.json"
    )
    data = Data(runs["train"], *_kinds_and_cheap(train, runs["train"]), runs["val"], runs["test"], costs)
    settings = {"train": runs["train"].key} | {name: vars(given)[name] for name in _DECISIVE}
    kept = out / f"selection-{digest_of(settings)[:12]}"
    kept.mkdir(parents=True, exist_ok=True)
    found: dict[Way, list[Result]] = {way: [] for way in WAYS}
    with counting("trainings", False, of=given.seeds * len(WAYS)) as seen:
        for seed in range(given.seeds):
            shop = Shop.of_seed(data, given, seed)
            for k, way in enumerate(WAYS):
                found[way].append(_result(shop, way, kept))
                seen(seed * len(WAYS) + k + 1, given.seeds * len(WAYS))
    _print_results(data, found)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("train", metavar="TRAIN", help="run of plan, all of whose candidates are labelled")
    for name in ("--selected", "--val", "--test", "--houses", "--objects", "--out"):
        parser.add_argument(name, required=True)
    parser.add_argument("--first", type=int, default=200, help="scenes of the first model [200]")
    parser.add_argument("--pool", type=int, default=1200, help="scenes of the pool [1200]")
    parser.add_argument("--per-scene", type=int, default=7, help="candidates selected in a scene [7]")
    parser.add_argument("--budget", type=float, default=300.0, help="CPU seconds of each way [300]")
    parser.add_argument("--shown", type=int, default=100_000, help="labels shown in a training [100000]")
    parser.add_argument("--steps", type=int, default=400, help="steps of a training [400]")
    parser.add_argument("--timed", type=int, default=40, help="scenes of TRAIN that are timed [40]")
    parser.add_argument("--seeds", type=int, default=5)
    return parser.parse_args()


def _kinds_and_cheap(run: Run, encoded: EncodedRuns) -> tuple[Array, Array]:
    """Kind of outcome and cheap label (S, K) of the candidates, in the order of `encoded`."""
    stored = read_whole_scenes(
        run, ("sample_scene_index", "candidate_index", "sample_id", "outcome", "heuristic_label")
    )
    ids, wanted = (
        np.ascontiguousarray(array).view("V16").ravel()
        for array in (stored["sample_id"], encoded.columns["sample_id"])
    )
    order = np.argsort(ids)
    row = order[np.searchsorted(ids[order], wanted)]
    shape = (len(encoded.houses), -1)
    return kinds_of(stored["outcome"][row]).reshape(shape), stored["heuristic_label"][row].reshape(shape)


@dataclass(frozen=True, eq=False)
class Shop:
    """Labels that one seed can buy: `pool` (P,) and `fresh` scenes of TRAIN, besides its `first` (S, K)."""

    data: Data
    given: argparse.Namespace
    seed: int
    first: Bools
    pool: I64
    fresh: I64

    @classmethod
    def of_seed(cls, data: Data, given: argparse.Namespace, seed: int) -> Shop:
        """Another division of the scenes for each seed."""
        order = np.random.default_rng(seed).permutation(len(data.kind))
        first, pool, fresh = np.split(order, [given.first, given.first + given.pool])
        whole = np.zeros(data.kind.shape, np.bool_)
        whole[first] = True
        return cls(data, given, seed, whole, np.sort(pool), fresh)

    def buy(self, way: Way) -> Purchase:
        """The purchase of this way for the budget."""
        if way == "new scenes":
            return self._new()
        if way == "uniform":
            return self._select(self.given.budget)
        chance, before_s = self.first_model
        if way == "uniform, as many labels":
            return self._select(self.given.budget - before_s)
        cheap = self.data.cheap[self.pool]
        unsure = unsureness(way, chance, 0.5, cheap.ravel()).reshape(cheap.shape)
        bought = self._select(self.given.budget - before_s, (way, unsure))
        return replace(bought, before_s=before_s)

    @cached_property
    def first_model(self) -> tuple[F64, float]:
        """Chances (P K,) of the pool by the first model, and the seconds that they cost."""
        trained = self.trained(self.first)
        chance = scores_of(trained.model, self.data.train, self.pool).astype(np.float64)
        return chance, trained.cost["train_cpu_s"] + len(self.pool) * self.data.costs.scored_scene_s

    def _select(self, budget_s: float, wanted: tuple[By, F64] | None = None) -> Purchase:
        """The largest selection that the budget pays. `wanted`: how to select, and unsureness (P, K)."""
        scenes, size, per_scene = len(self.pool), self.data.kind.shape[1], self.given.per_scene

        def drawn(n: int) -> Purchase:
            rng = np.random.default_rng([self.seed, n])
            if wanted is None:
                sample = draw_sample(all_alike(scenes, size, n, per_scene), n, per_scene, 1.0, rng)
            else:
                sample = draw_sample(design_by(*wanted, n, per_scene, rng), n, per_scene, _RANDOM_SHARE, rng)
            chosen = np.zeros(self.data.kind.shape, np.bool_)
            chosen[self.pool[sample.scene][:, None], sample.candidate] = True
            return Purchase(chosen, 0.0, self.data.costs.labels_s(self.data.kind[chosen], n, again=True))

        low, high = 1, scenes
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if drawn(middle).labels_s <= budget_s else (low, middle - 1)
        return drawn(low)

    def _new(self) -> Purchase:
        """All candidates of as many new scenes as the budget pays."""
        kind, costs = self.data.kind, self.data.costs
        seconds = np.cumsum([costs.labels_s(kind[scene], 1, again=False) for scene in self.fresh])
        n = int(np.searchsorted(seconds, self.given.budget, side="right"))
        if n == len(self.fresh):
            raise SystemExit(f"all {n} new scenes cost {seconds[-1]:.0f} s: give a smaller --budget")
        chosen = np.zeros(kind.shape, np.bool_)
        chosen[self.fresh[:n]] = True
        return Purchase(chosen, 0.0, float(seconds[n - 1]))

    def trained(self, chosen: Bools) -> Trained:
        """A model trained on these candidates (S, K) alone."""
        data, rows = self.data, chosen.ravel()
        columns = {
            name: values[rows] if len(values) == len(rows) else values
            for name, values in data.train.columns.items()
        }
        scenes = np.flatnonzero(chosen.any(axis=1))
        epochs = max(1, round(self.given.shown / rows.sum()))
        # The same number of steps for all ways, however many candidates a scene has.
        batch_scenes = max(1, round(len(scenes) * epochs / self.given.steps))
        stage = STAGES["sim-only"]
        options = Options("sim-only", "shared", MODEL_CONFIG, epochs, batch_scenes, lr=stage.lr,
                          weight_decay=stage.weight_decay, seed=self.seed)  # fmt: skip
        trained = train_encoded(
            options,
            EncodedBatches(replace(data.train, columns=columns), scenes, batch_scenes, self.seed),
            EncodedBatches(data.val, np.arange(len(data.val.houses)), batch_scenes),
            None,
            lambda: False,
        )
        assert trained is not None
        return trained


def _result(shop: Shop, way: Way, kept: Path) -> Result:
    """The result of a way, read from `kept` if it exists there."""
    file = kept / f"{shop.seed}-{way.replace(', ', '-').replace(' ', '-')}.npz"
    if not file.exists():
        bought = shop.buy(way)
        chosen, test = bought.chosen, shop.data.test
        model = shop.trained(shop.first | chosen).model
        good = (shop.data.kind[chosen] == 0).mean()
        scenes = chosen.any(axis=1).sum()
        numbers = np.array([chosen.sum(), scenes, good, bought.before_s, bought.labels_s])
        with whole_file(file) as written:
            np.savez(written, numbers=numbers, scores=scores_of(model, test)[test.in_range])
    with np.load(file) as arrays:
        return Result(arrays["numbers"], arrays["scores"])


def _print_results(data: Data, found: dict[Way, list[Result]]) -> None:
    label = data.test.label[data.test.in_range] == 1
    _, scene = np.unique(data.test.scene_of_candidate[data.test.in_range], return_inverse=True)
    test = TestSet(label, scene)
    rng = np.random.default_rng(0)
    weights = resample_weights(test.n_scenes, _RESAMPLES, rng)
    n = len(found["uniform"])
    seeds = rng.integers(0, n, (_RESAMPLES, n))
    values = {
        way: [[measured(metric, test, r.scores, weights) for r in results] for metric in METRICS]
        for way, results in found.items()
    }
    print(f"{len(label):,} test candidates of {test.n_scenes:,} scenes; means of {n} seeds")
    print(f"{'':<25}{'labels':>8}{'scenes':>8}{'good':>7}{'before':>8}{'labels':>8}"
          f"{'balanced accuracy':>20}{'AUC':>20}{'over uniform':>21}{'AUC':>21}")  # fmt: skip
    for way, results in found.items():
        cells = [_cell(mean_over_seeds(of_seeds, seeds)) for of_seeds in values[way]]
        for of_seeds, uniform in zip(values[way], values["uniform"], strict=True):
            apart = [a.minus(b) for a, b in zip(of_seeds, uniform, strict=True)]
            cells.append(_cell(mean_over_seeds(apart, seeds), sign=True))
        labels, scenes, good, before_s, labels_s = np.mean([r.numbers for r in results], axis=0)
        print(f"{way:<25}{labels:>8,.0f}{scenes:>8,.0f}{good:>7.1%}{before_s:>6.0f} s{labels_s:>6.0f} s"
              f"{cells[0]:>20}{cells[1]:>20}{cells[2]:>21}{cells[3]:>21}")  # fmt: skip


def _cell(estimate: Estimate, sign: bool = False) -> str:
    one = "{:+.1f}" if sign else "{:.1f}"
    value, low, high = (one.format(100 * x) for x in (estimate.value, *estimate.interval()))
    return f"{value} [{low}, {high}]"


if __name__ == "__main__":
    main()
