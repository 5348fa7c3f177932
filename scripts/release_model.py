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
from datagen.evaluation.report_tables import DECISIONS
from datagen.released.card import card_text
from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import whole_file
from datagen.train.prediction import load_scorer
from datagen.train.scorers import ModelScorer, weights_sha256
from datagen.train.training.checkpoints import Checkpoint, load_model, read_checkpoint, write_checkpoint

MOST_BYTES = 5_000_000


def results_of(path: Path, checkpoint: Path) -> tuple[dict[str, Any], str]:
    """The report of the benchmark, and the name of this checkpoint in it. InputError where it has none."""
    try:
        report = json.loads(path.read_bytes())
        methods = {m["name"]: m["checkpoint"] for m in report["methods"] if m["checkpoint"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        fix = "Give a file of `datagen benchmark score --out`"
        raise InputError(path, "", f"is no report of the benchmark ({error})", fix) from None
    digest = weights_sha256(load_model(checkpoint)[0])
    for name, record in methods.items():
        if record["weights_sha256"] == digest:
            return report, name
    raise InputError(path, "methods", f"has no line of the weights of {checkpoint}", "Score the checkpoint")


def ship(source: Path, target: Path) -> None:
    """Write the checkpoint without the optimiser's state. InputError where it is too large."""
    checkpoint = read_checkpoint(source)
    draft = target.with_suffix(".draft")
    write_checkpoint(draft, Checkpoint(replace(checkpoint.head, finished=True), checkpoint.weights))
    if (size := draft.stat().st_size) > MOST_BYTES:
        draft.unlink()
        raise InputError(source, "", f"has {size:,} bytes of weights", f"Ship at most {MOST_BYTES:,}")
    draft.replace(target)


def facts_of(path: Path, report: dict[str, Any], name: str) -> dict[str, Any]:
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
        "benchmark": {key: report["benchmark"][key] for key in ("version", "digest")},
        "metrics": metrics_of(report, name),
        "demo": demo_answer(scorer),
    }


def metrics_of(report: dict[str, Any], name: str) -> dict[str, Any]:
    """The numbers that the card names, by part of the report."""
    found: dict[str, Any] = {}
    for part in report["parts"]:
        if grids := part["grids"]:
            arrivals = {row["arrival"]: row["methods"][name] for row in grids["arrivals"]}
            good = grids["methods"][name]["good"]
            found[part["title"]] = {"scenes": grids["scenes"], "good": good, "arrivals": arrivals}
        for scores in part["sets"].values():
            kept = (*DECISIONS, "expected_calibration_error", "brier")
            metrics = {key: scores["methods"][name][key] for key in kept}
            found[part["title"]] = {"count": scores["count"], "scenes": scores["scenes"], **metrics}
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
    """Write checkpoint and card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("benchmark", type=Path)
    options = parser.parse_args()
    target = released.FOLDER / released.CHECKPOINT
    try:
        report, name = results_of(options.benchmark, options.checkpoint)
        ship(options.checkpoint, target)
        card = facts_of(target, report, name)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    with whole_file(released.FOLDER / released.CARD, alone=True) as file:
        file.write((json.dumps(card, indent=1, allow_nan=False) + "\n").encode())
    with whole_file(released.FOLDER / released.CARD_PAGE, alone=True) as file:
        file.write(card_text(card, (released.FOLDER / released.RECIPE).read_text("utf-8")).encode())
    size, weights = card["bytes"], card["weights_sha256"][:12]
    print(f"{target}: {size:,} bytes, weights {weights}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
