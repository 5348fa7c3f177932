"""The section of a checkpoint: model, training data, cost, and the course of training."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from datagen.console.printing import counted, seconds
from datagen.display.figures import new_figure, svg_of
from datagen.display.html_page import html_facts, html_figure, html_table
from datagen.display.styles import MODEL_COLOURS

if TYPE_CHECKING:
    from datagen.train.training.checkpoints import CheckpointHead


def read_head(path: Path) -> CheckpointHead:
    """The metadata of a checkpoint. InputError for other files."""
    # Imported here: torch takes seconds to load, and a report of runs does not need it.
    from datagen.train.training.checkpoints import read_checkpoint

    return read_checkpoint(path).head


def checkpoint_section(path: Path, head: CheckpointHead, name: str) -> list[str]:
    """The section as HTML below its heading."""
    cost = ", ".join(
        f"{key.removesuffix('_s').replace('_', ' ')} {seconds(s)}" for key, s in head.cost.items()
    )
    facts = [
        ("file", str(path)),
        ("sha256", head.digest),
        ("model", head.model),
        ("stage", head.stage),
        ("state", state_words(head)),
        ("trained on", f"{len(head.house_ids):,} houses, {len(head.object_digests):,} objects"),
        ("chosen in", f"{len(head.val_house_ids):,} houses of validation"),
        ("cost", cost),
        ("versions", ", ".join(f"{k} {v}" for k, v in sorted(head.versions.items()))),
        ("began from", str(head.init.get("digest", "")) if head.init else "fresh weights"),
        ("options", ", ".join(f"{k} {v}" for k, v in sorted(head.options.items()))),
    ]
    data = [
        (use, f"{origin['n_samples']:,}", f"{origin['n_scenes']:,}", origin["schema"], hashes)
        for use, origins in (("training", head.data), ("validation", head.val_data))
        for origin in origins
        for hashes in [", ".join(origin["spec_hashes"])]
    ]  # fmt: skip
    body = [html_facts((k, v) for k, v in facts if v)]
    if data:
        body += [
            "<h3>Data</h3>",
            html_table(("used for", "labels", "scenes", "source", "specification"), data, "text"),
        ]
    if head.history:
        body += ["<h3>Training</h3>", html_figure(svg_of(_draw_history(head), f"{name}-history"))]
    return body


def state_words(head: CheckpointHead) -> str:
    """Epochs, the best of them, and whether training is finished."""
    best = f", the best is epoch {head.best_epoch}" if head.best_epoch is not None else ""
    return f"{counted(head.epoch, 'epoch')}{best}{'' if head.finished else ', not finished'}"


def _draw_history(head: CheckpointHead) -> Figure:
    """Draw loss and accuracy of training and validation by epoch."""
    figure = new_figure(12, 3.4)
    epochs = [record["epoch"] for record in head.history]
    for ax, keys, title in zip(
        figure.subplots(1, 2),
        (("loss", "val_loss"), ("accuracy", "val_accuracy")),
        ("loss", "accuracy"),
        strict=True,
    ):
        for key, words, colour, line in zip(
            keys, ("training", "validation"), MODEL_COLOURS, ("o--", "s-"), strict=False
        ):
            ax.plot(epochs, [record[key] for record in head.history], line, ms=4, color=colour, label=words)
        if head.best_epoch is not None:
            ax.axvline(head.best_epoch, color="#999999", lw=0.8, ls=":")
        ax.set(title=title, xlabel="epoch; the dotted line is the best")
        ax.grid(color="#e4e4e4", lw=0.7)
        ax.legend(frameon=False, fontsize=9)
    return figure
