"""Put a checkpoint into the package as the released model, with its card.

    python -m scripts.release_model CKPT BENCHMARK.json

BENCHMARK.json is the output of `datagen benchmark score CKPT ... --out BENCHMARK.json`. The optimiser's state
is left out of the shipped file, and its program for NumPy is written beside it. `datagen/released/recipe.md`
describes how the model is made: write it first. The card includes the result of the demonstration.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from datagen import released
from datagen.commands.predict import predict
from datagen.evaluation.report_tables import DECISIONS
from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import whole_file
from datagen.train.program_scorer import ProgramScorer
from datagen.train.scorers import weights_sha256
from datagen.train.training.checkpoints import Checkpoint, load_model, read_checkpoint, write_checkpoint
from scripts.export_program import write_program

Facts = Mapping[str, Any]

_LIMITS = """## Limits

- It was trained on planned labels in generated houses with scanned objects, from one view without noise and
  with an exact mask of the target. How it does in real rooms is not measured.
- It was trained on six arms with five hands: a Panda scaled to reaches of 0.3 to 1.0 m, xArm7, Fetch, TIAGo
  Pro, UR5 on a wide base and Stretch 3. For another arm it reads that arm's reach and hand from its file; how
  it does on one that it has not seen is in docs/results/base-poses.md, and further training helps.
- A good score is the chance that the arm finds a plan from there. The arm's own planner has the last word.
- It does not see where the base fits; `datagen predict` finds that in the frame.
- It is no safety device: nothing here keeps a robot from driving into anything.
"""
_LICENCES = """## Licences

The weights are under Apache-2.0, as the package is. They were learned from houses that ProcTHOR made (the
generator and its own houses: Apache-2.0; most of the repositories that hold these houses state no licence of
their own) and from the YCB Object and Model Set (B. Calli et al., ycbbenchmarks.com, CC BY 4.0). The
checkpoint names them and holds no part of them. `frame/ATTRIBUTION.md` names the sources of the sample frame.
"""
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
    program = ProgramScorer(released.FOLDER / released.PROGRAM, only_clear=True)
    return {
        "file": path.name,
        "bytes": path.stat().st_size,
        "sha256": sha256(path.read_bytes()).hexdigest(),
        "weights_sha256": program.program.facts["weights_sha256"],
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
        "demo": demo_answer(program),
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


def demo_answer(scorer: ProgramScorer) -> dict[str, Any]:
    """The result of `datagen predict --demo`, without its pictures."""
    answer = predict(
        scorer,
        frame=[released.sample_frame()],
        map=[released.sample_frame() / released.MAP],
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
        "level": answer.level,
    }


def card_text(card: Facts, recipe: str) -> str:
    """The model card in Markdown."""
    return "\n".join(
        [
            "# The released model\n",
            "`card.json` has the same facts (`scripts/release_model.py`).\n",
            _about(card),
            _metrics(card),
            _demo(card["demo"]),
            _data(card),
            _LIMITS,
            _LICENCES,
            recipe.strip() + "\n",
        ]
    )


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, tuple("---" for _ in heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _about(card: Facts) -> str:
    rows = [
        ("file", f"`{card['file']}`, {card['bytes']:,} bytes"),
        ("sha256", card["sha256"]),
        ("sha256 of the weights", card["weights_sha256"]),
        ("model", f"`{card['model']}`, {card['parameters']:,} parameters"),
        ("training", f"{card['stage']}, best epoch {card['best_epoch']}"),
        ("input", "a cloud around the target, the target's mask, robot heights and reach, base poses"),
        ("output", "the chance of each base pose that the arm finds a plan to lift the target"),
    ]
    return _table(("", ""), rows)


def _metrics(card: Facts) -> str:
    version, digest = card["benchmark"]["version"], card["benchmark"]["digest"][:12]
    decisions = [
        (run, f"{scores['count']:,} of {scores['scenes']:,} scenes", _interval(scores["balanced_accuracy"]),
         _interval(scores["area_under_roc"]), _percent(scores["expected_calibration_error"]),
         _interval(scores["accuracy"]))
        for run, scores in card["metrics"].items() if "balanced_accuracy" in scores
    ]  # fmt: skip
    grids = {run: scores for run, scores in card["metrics"].items() if "good" in scores}
    text = f"## Results\n\nIn percent, on benchmark version {version} ({digest}), 95% intervals by scene:\n\n"
    heads = ("run", "candidates", "balanced accuracy", "AUC", "calibration error", "accuracy")
    text += _table(heads, decisions)
    if grids:
        arrivals = list(next(iter(grids.values()))["arrivals"])
        rows = [
            (run, f"{scores['scenes']:,}", _interval(scores["good"]), pick,
             *(_percent(scores["arrivals"][a][pick]["value"]) for a in arrivals))
            for run, scores in grids.items() for pick in ("nominal", "smoothed")
        ]  # fmt: skip
        text += "\nPicks on whole grids, and their success where the robot parks off them:\n\n"
        text += _table(("run", "grids", "best cell good", "pick", *arrivals), rows)
    return text


def _demo(demo: Facts) -> str:
    x, y = demo["base_xy_m"]
    return (
        "## Demonstration\n\n`datagen predict --demo` answers on the sample frame: the base at "
        f"({x:.3f}, {y:.3f}) m, yaw {math.degrees(demo['yaw_rad']):.1f} deg, score {demo['score']:.3f}, "
        f"{demo['clear']} clear poses.\n"
    )


def _data(card: Facts) -> str:
    rows = [
        (use, f"{each['n_samples']:,} {each['schema']} labels in {each['n_scenes']:,} scenes",
         ", ".join(h[:12] for h in each["spec_hashes"]), each["samples_sha256"][:12])
        for use, data in (("training", card["data"]), ("validation", card["val_data"])) for each in data
    ]  # fmt: skip
    trained = f"{card['houses']:,} houses and {card['objects']:,} objects in training"
    counts = f"\n{trained}, {card['val_houses']:,} houses in validation.\n"
    heads = ("use", "labels", "specification", "ids and labels")
    return "## Data\n\n" + _table(heads, rows) + counts


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _interval(estimate: Facts) -> str:
    if estimate["low"] is None:
        return _percent(estimate["value"])
    return f"{_percent(estimate['value'])} [{_percent(estimate['low'])}, {_percent(estimate['high'])}]"


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
        write_program(target, released.FOLDER / released.PROGRAM)
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
