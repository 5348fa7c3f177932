"""The section of a checkpoint: what it is, how well it does, what it was trained on, and its provenance."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from datagen.console.printing import counted, seconds
from datagen.display.figures import svg_of
from datagen.display.html_page import html_facts, html_figure, html_table
from datagen.html_report.figures import draw_history
from datagen.train.training.checkpoints import read_checkpoint


def model_section(path: Path, name: str) -> Iterator[str]:
    """The section as HTML below its heading; `name` makes its ids unique. InputError for another file."""
    head = read_checkpoint(path).head
    best = [record for record in head.history if record["epoch"] == head.best_epoch]
    accuracy = f"{100 * best[0]['val_accuracy']:.1f}% of the labels of validation" if best else "not known"
    state = counted(head.epoch, "epoch") + (f", the best is {head.best_epoch}" if best else "")
    began = f"checkpoint {head.init.get('digest', '')}" if head.init else "fresh weights"
    yield html_facts(
        [
            ("model", f"{head.model}, trained as {head.stage}"),
            ("accuracy", accuracy),
            ("training", state if head.finished else f"{state}, not finished"),
            ("trained on", f"{len(head.house_ids):,} houses, {len(head.object_digests):,} objects"),
            ("validated in", f"{len(head.val_house_ids):,} other houses"),
        ]
    )
    if head.history:
        figure = draw_history(head.history, head.best_epoch)
        yield "<h3>Course of training</h3>" + html_figure(svg_of(figure, name))
    data = [
        (
            use,
            f"{origin['n_samples']:,}",
            f"{origin['n_scenes']:,}",
            origin["schema"],
            ", ".join(origin["spec_hashes"]),
        )
        for use, origins in (("training", head.data), ("validation", head.val_data))
        for origin in origins
    ]
    heads = ("used for", "labels", "scenes", "source", "specification")
    yield "<h3>Data</h3>" + html_table(heads, data, "text")
    cost = [(key.removesuffix("_s").replace("_", " "), seconds(spent)) for key, spent in head.cost.items()]
    yield "<h3>Cost</h3>" + html_table(("", "time"), cost)
    options, versions = (
        ", ".join(f"{k} {v}" for k, v in sorted(d.items()) if v) for d in (head.options, head.versions)
    )
    facts = [("file", str(path)), ("sha256", head.digest), ("began from", began)]
    yield "<h3>Provenance</h3>" + html_facts([*facts, ("options", options), ("versions", versions)])
