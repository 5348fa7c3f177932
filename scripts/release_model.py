"""Put a checkpoint into the package as the released model, with its card.

    python scripts/release_model.py CKPT BENCHMARK.json

BENCHMARK.json is the output of `datagen benchmark score CKPT ... --out BENCHMARK.json`. The optimiser's state
is left out of the shipped file. `datagen/released/recipe.md` describes how the model is made: write it first.
The card includes the result of the demonstration.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from datagen import released
from datagen.commands.predict import predict
from datagen.released.card import card_text
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file
from datagen.train.prediction import load_scorer
from datagen.train.scorers import ModelScorer, weights_sha256
from datagen.train.training.checkpoints import Checkpoint, load_model, read_checkpoint, write_checkpoint

MOST_BYTES = 5_000_000


def results_of(path: Path, checkpoint: Path) -> dict[str, Any]:
    """The leaderboard with the one line of this checkpoint. InputError where it has none."""
    try:
        report = json.loads(path.read_bytes())
        methods = {m["name"]: m for m in report["methods"] if m.get("checkpoint")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        fix = "Give a file of `datagen benchmark score --out`"
        raise InputError(path, "", f"is no leaderboard ({error})", fix) from None
    digest = weights_sha256(load_model(checkpoint)[0])
    for name, record in methods.items():
        if record["checkpoint"]["weights_sha256"] == digest:
            return _only(report, name, record)
    raise InputError(path, "methods", f"has no line of the weights of {checkpoint}", "Score the checkpoint")


def _only(report: dict[str, Any], name: str, record: dict[str, Any]) -> dict[str, Any]:
    """The report without other methods, the line under the name of the released model."""

    def cut(value: Any) -> Any:
        if isinstance(value, dict):
            known = {k: cut(v) for k, v in value.items() if k not in ("differences", "means")}
            if isinstance(methods := known.get("methods"), dict):
                known["methods"] = {released.RELEASED: methods[name]}
            return known
        return [cut(each) for each in value] if isinstance(value, list) else value

    return {**cut(report), "methods": [{**record, "name": released.RELEASED}], "fitted_on": []}


def ship(source: Path, target: Path) -> None:
    """Write the checkpoint without the optimiser's state. InputError where it is too large."""
    checkpoint = read_checkpoint(source)
    draft = target.with_suffix(".draft")
    write_checkpoint(draft, Checkpoint(replace(checkpoint.head, finished=True), checkpoint.weights))
    if (size := draft.stat().st_size) > MOST_BYTES:
        draft.unlink()
        raise InputError(source, "", f"has {size:,} bytes of weights", f"Ship at most {MOST_BYTES:,}")
    draft.replace(target)


def facts_of(path: Path, results: dict[str, Any]) -> dict[str, Any]:
    """The card of the shipped checkpoint at `path`."""
    checkpoint = read_checkpoint(path)
    head = checkpoint.head
    scorer = load_scorer(path)
    return {
        "file": path.name,
        "bytes": path.stat().st_size,
        "sha256": sha256(path.read_bytes()).hexdigest(),
        "weights_sha256": weights_sha256(scorer.model),
        "parameters": sum(tensor.numel() for tensor in checkpoint.weights.values()),
        "model": head.model,
        "config": head.model_config,
        "stage": head.stage,
        "options": head.options,
        "init": head.init,
        "best_epoch": head.best_epoch,
        "data": list(head.data),
        "val_data": list(head.val_data),
        "houses": len(head.house_ids),
        "val_houses": len(head.val_house_ids),
        "objects": len(head.object_digests),
        "cost": head.cost,
        "versions": head.versions,
        "benchmark": {key: results["benchmark"][key] for key in ("version", "digest")},
        "metrics": metrics_of(results),
        "demo": demo_answer(scorer),
    }


def metrics_of(results: dict[str, Any]) -> dict[str, Any]:
    """The numbers that the card names, by run."""
    name = released.RELEASED
    found: dict[str, Any] = {
        run: {"count": table["candidates"], "scenes": table["scenes"], **table["methods"][name]}
        for run, table in results["candidates"].items()
    }
    for run, table in results["grids"].items():
        for which in ("mixed", "hard"):
            if (part := table[which]) is not None:
                found[f"{run}, {which}"] = {
                    "scenes": part["scenes"],
                    "good": part["methods"][name]["good"],
                    "arrivals": {row["arrival"]: row["methods"][name] for row in part["arrivals"]},
                }
    return found


def demo_answer(scorer: ModelScorer) -> dict[str, Any]:
    """The result of `datagen predict --demo`, without its pictures."""
    answer = predict(
        scorer,
        frame=[released.sample_frame()],
        click=released.DEMO_CLICK,
        base_height=released.DEMO_BASE_HEIGHT_M,
        reach=released.DEMO_REACH_M,
    )
    best = answer.best
    if best is None:
        raise InputError(released.sample_frame(), "", "the model finds no base pose", "Choose another frame")
    return {
        "base_xy_m": answer.base_xy_m[best].tolist(),
        "yaw_rad": float(answer.yaw_rad[best]),
        "score": float(answer.score[best]),
        "clear": len(answer.rows("clear")),
        "sure": answer.sure,
    }


def main() -> int:
    """Write checkpoint, results and card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("benchmark", type=Path)
    options = parser.parse_args()
    target = released.FOLDER / released.CHECKPOINT
    try:
        results = results_of(options.benchmark, options.checkpoint)
        ship(options.checkpoint, target)
        card = facts_of(target, results)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    files = {released.RESULTS: results, released.CARD: card}
    for name, values in files.items():
        with whole_file(released.FOLDER / name, alone=True) as file:
            file.write((json.dumps(values, indent=1, allow_nan=False) + "\n").encode())
    with whole_file(released.FOLDER / released.CARD_PAGE, alone=True) as file:
        file.write(card_text(card, (released.FOLDER / released.RECIPE).read_text("utf-8")).encode())
    size, weights = card["bytes"], card["weights_sha256"][:12]
    print(f"{target}: {size:,} bytes, weights {weights}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
