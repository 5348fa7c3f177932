"""A checkpoint without training: prediction cares for its form."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from datagen.train.models import build_model
from datagen.train.training.checkpoints import Checkpoint, CheckpointHead, write_checkpoint


def write_untrained(file: Path, config: Mapping[str, Any]) -> None:
    """The same parameters each time."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        model = build_model("shared", config)
    head = CheckpointHead(
        model="shared", model_config=model.config, stage="stage1", options={}, data=(), val_data=(),
        house_ids=(), object_digests=(), val_house_ids=(), cost={}, versions={}, history=(),
    )  # fmt: skip
    write_checkpoint(file, Checkpoint(head, model.state_dict()))
