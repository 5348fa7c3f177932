"""Whether fast trainings rank mixtures of labels as `datagen train` does: accuracy and CPU time.

    python -m benchmarks.frontier HEURISTIC PLAN --val VAL --test TEST --out FOLDER [--shares 0.125 1]

- full: `datagen train` with its defaults, from clouds (stage 1 on --stage1-share of the heuristic houses)
- tokens: `datagen frontier`, small models from cached tokens
- frozen: the pooled features of the stage-1 model of "tokens", and a new head trained on them

The last two have the same houses; "full" has as many others. Finished trainings in FOLDER are used again.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr
from torch import Tensor

from datagen import cli
from datagen.frontier.mixtures import MODEL_CONFIG, Mixture, Stage
from datagen.frontier.trainings import TrainingTask, make_trainings, read_result
from datagen.train.encoded.batches import EncodedBatches, subset_of_houses
from datagen.train.encoded.runs import EncodedRuns, encode_runs, encoded_stream
from datagen.train.evaluation.metrics import area_under_roc, balanced_accuracy, confusion
from datagen.train.inputs import F32
from datagen.train.models.shared import SharedModel, mlp
from datagen.train.scorers import ModelScorer
from datagen.train.tensors import to_torch
from datagen.train.training.checkpoints import load_model

Row = tuple[float, float, float]  # balanced accuracy, AUC, CPU seconds


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("heuristic")
    parser.add_argument("plan")
    parser.add_argument("--val", required=True)
    parser.add_argument("--test", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.125, 1.0])
    parser.add_argument("--stage1-share", type=float, default=0.25)
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = Path(options.out)
    paths = {"heuristic": options.heuristic, "plan": options.plan, "val": options.val, "test": options.test}
    data = {
        name: encode_runs(
            encoded_stream([path], False), SharedModel(MODEL_CONFIG), out / "encodings", lambda *_: None
        )
        for name, path in paths.items()
    }
    share: float = options.stage1_share
    first = Stage("heuristic", share)
    mixtures = [Mixture((first,))]
    mixtures += [Mixture((Stage("plan", s),)) for s in options.shares]
    mixtures += [Mixture((first, Stage("plan", s))) for s in options.shares]
    folders = {name: str(out / "encodings" / encoded.key) for name, encoded in data.items()}
    tasks = [TrainingTask(mixture, 0, folders, str(out)) for mixture in mixtures]
    rows: dict[str, list[Row]] = {"full": [], "tokens": [], "frozen": []}
    rows["full"] = [_full(mixture, paths, out, data["test"]) for mixture in mixtures]
    assert make_trainings(tasks, 1, lambda: False, lambda *_: None)
    stage1 = SharedModel(MODEL_CONFIG)
    stage1.load_state_dict(_weights(tasks[0].path))

    label = data["test"].label[data["test"].in_range] == 1
    print(f"{'':<34}{'full':>22}{'tokens':>22}{'frozen':>22}")
    for k, task in enumerate(tasks):
        result = read_result(task)
        rows["tokens"].append((*_judged(label, result.scores), result.record["cost"]["train_cpu_s"]))
        last = task.mixture.stages[-1]
        if last.source == "plan" and task.before is not None:
            rows["frozen"].append(_frozen(stage1, data, last.share))
        name = f"{task.mixture.name}, {last.share:.1%}"
        shown = [_shown(rows["full"][k]), _shown(rows["tokens"][k])]
        shown += [_shown(rows["frozen"][-1])] if task.before is not None else []
        print(f"{name:<34}" + "".join(f"{text:>22}" for text in shown), flush=True)
    for k, metric in enumerate(("balanced accuracy", "AUC")):
        pairs = [[row[k] for row in rows[way]] for way in ("full", "tokens")]
        print(f"rank correlation of full and tokens, {metric}: {spearmanr(*pairs).statistic:.2f}")


def _shown(row: Row) -> str:
    return f"{100 * row[0]:.1f} {100 * row[1]:.1f} {row[2]:.0f} s"


def _judged(label: Any, scores: F32) -> tuple[float, float]:
    predicted = (scores >= 0.5).astype(np.float64)
    counts = confusion(predicted, label, np.zeros(len(label), np.int64), 1)[0]
    return float(balanced_accuracy(counts)), area_under_roc(label, scores.astype(np.float64))


def _full(mixture: Mixture, paths: dict[str, str], out: Path, test: EncodedRuns) -> Row:
    """`datagen train`, stage by stage, and its scores of the test run's clouds."""
    last, before = mixture.stages[-1], mixture.before
    stage = "stage1" if last.source == "heuristic" else "stage2" if before else "sim-only"

    def checkpoint(name: str, share: float) -> Path:
        return out / f"{name}-{share:g}.ckpt"

    words = ["train", stage, paths[last.source], "--house-share", str(last.share), "--threads", "1"]
    words += ["--out", str(checkpoint(stage, last.share)), "--device", "cpu"]
    if last.source == "plan":
        words += ["--val", paths["val"]]
    if before is not None:
        words += ["--init", str(checkpoint("stage1", before.stages[-1].share))]
    assert cli.run(words) == 0
    model, head = load_model(checkpoint(stage, last.share))
    scorer = ModelScorer(model, "full")
    scores = np.concatenate(
        [scorer.score(batch) for batch in encoded_stream([paths["test"]], False).epoch(0)]
    )
    return (*_judged(test.label[test.in_range] == 1, scores[test.in_range]), head.cost["train_cpu_s"])


def _frozen(model: SharedModel, data: dict[str, EncodedRuns], share: float) -> Row:
    """A new head on the pooled features of a frozen model."""
    began = time.process_time()
    scenes = subset_of_houses(data["plan"], share, 0)
    learn, judge, test = (
        _features(model, encoded, some)
        for encoded, some in (
            (data["plan"], scenes),
            (data["val"], np.arange(len(data["val"].houses))),
            (data["test"], np.arange(len(data["test"].houses))),
        )
    )
    torch.manual_seed(0)
    width = learn[0].shape[1]
    head = torch.nn.Sequential(torch.nn.LayerNorm(width), mlp(width, (128, 64), 2))
    optimiser = torch.optim.AdamW(head.parameters(), lr=2e-3, weight_decay=1e-2)
    best, scores = float("inf"), np.zeros(len(test[1]), np.float32)
    rng = np.random.default_rng(0)
    for _ in range(30):
        for rows in np.array_split(rng.permutation(len(learn[1])), max(1, len(learn[1]) // 256)):
            loss = torch.nn.functional.cross_entropy(head(learn[0][rows]), learn[1][rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        with torch.no_grad():
            now = float(torch.nn.functional.cross_entropy(head(judge[0]), judge[1]))
            if now < best:
                best, scores = now, torch.softmax(head(test[0]), dim=1)[:, 1].numpy()
    within = data["test"].in_range
    return (*_judged(test[1].numpy()[within] == 1, scores[within]), time.process_time() - began)


def _features(model: SharedModel, encoded: EncodedRuns, scenes: Any) -> tuple[Tensor, Tensor]:
    """Inputs (N, 2E) of the model's head for these scenes' candidates, and their labels (N,)."""
    found: list[Tensor] = []
    handle = model.eval().head.register_forward_pre_hook(lambda _, given: found.append(given[0]))
    labels: list[Tensor] = []
    with torch.no_grad():
        for batch in EncodedBatches(encoded, scenes, 16).epoch(0):
            given = to_torch(batch, "cpu")
            model.score(given.clouds, given.candidates, given.robots)
            labels.append(given.label)
    handle.remove()
    return torch.cat(found), torch.cat(labels)


def _weights(path: Path) -> dict[str, Tensor]:
    with np.load(path, allow_pickle=False) as file:
        names = [name for name in file.files if name.startswith("weights/")]
        return {name.removeprefix("weights/"): torch.from_numpy(file[name]) for name in names}


if __name__ == "__main__":
    main()
