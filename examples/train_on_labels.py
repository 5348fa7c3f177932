"""Train the ready-made model on labels, or read them in a training loop of your own.

Usage: python examples/train_on_labels.py [FOLDER]   (after examples/make_labels.py [FOLDER])
"""

import sys
from pathlib import Path

import torch
from torch.utils.data import DataLoader

import datagen


def ready_made(folder: Path) -> None:
    """The project's model; the same call continues a training that was interrupted."""
    head = datagen.train_model(
        "stage1",
        [folder / "train"],
        val=[folder / "val"],
        out=folder / "model.ckpt",
        epochs=6,
        device="cpu",
    )
    best = head.history[(head.best_epoch or 1) - 1]
    print(f"{folder / 'model.ckpt'}: epoch {head.best_epoch}, validation accuracy {best['val_accuracy']:.2f}")


def your_own(folder: Path) -> None:
    """A logistic regression on the base's distance and bearing, from the same stream."""
    stream = datagen.stream(folder / "train", scenes_per_batch=2, seed=0)
    loader = DataLoader(stream, batch_size=None, num_workers=1)
    model = torch.nn.Linear(3, 1)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    for epoch in range(3):
        stream.set_epoch(epoch)  # another order; `skip_batches` continues within an epoch
        for batch in loader:
            x, y = batch.candidates.base_xy_m.T  # in the target's frame, m
            features = torch.stack([torch.hypot(x, y), x, y], dim=1)
            loss = torch.nn.functional.binary_cross_entropy_with_logits(
                model(features)[:, 0], batch.label.float()
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        print(f"epoch {epoch}: loss {loss.item():.3f}")


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "example-runs")
    ready_made(folder)
    your_own(folder)
