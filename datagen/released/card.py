"""The model card as a page, from its facts and the recipe."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Facts = Mapping[str, Any]

_LIMITS = """## Limits

- It was trained on planned labels in generated houses with scanned objects, from one view without noise and
  with an exact mask of the target. How it does in real rooms is not measured.
- It was trained on one kind of arm, a Panda scaled to reaches of 0.3 to 1.0 m, on bases of 0.5 to 1.0 m. On
  an xArm7 it is a little worse, on a Fetch much worse until it is trained further on labels of it
  (docs/results/base-poses.md); other arms are not measured.
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
