"""Checkpoints without training, and with entries that no training writes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import safe_open

from datagen.train.models import build_model
from datagen.train.training.checkpoints import Checkpoint, CheckpointHead, write_checkpoint


def write_untrained(file: Path, config: Mapping[str, Any], logit: float = 1.0) -> None:
    """The same parameters each time; scores are near that of the logit."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        model = build_model("shared", config)
    head = CheckpointHead(
        model="shared", model_config=model.config, stage="stage1", options={}, data=(), val_data=(),
        house_ids=(), object_digests=(), val_house_ids=(), cost={}, versions={}, history=(),
    )  # fmt: skip
    weights = dict(model.state_dict())
    last = list(weights)[-1]
    write_checkpoint(file, Checkpoint(head, weights | {last: weights[last] + torch.tensor([0.0, logit])}))


def document_of(path: Path) -> dict[str, Any]:
    """The JSON of its header."""
    with safe_open(path, "pt") as stored:
        return json.loads(stored.metadata()["head"])


def stored_with(
    path: Path, source: Path, tensors: Mapping[str, torch.Tensor] | None = None, **changes: Any
) -> Path:
    """The checkpoint with other tensors or another document, as safetensors alone writes it, signed."""
    stored = {**safetensors.torch.load_file(source), **(tensors or {})}
    return signed(path, stored, {**document_of(source), **changes})


def signed(path: Path, tensors: Mapping[str, torch.Tensor], document: dict[str, Any]) -> Path:
    """A file of tensors and document whose checksum is right."""
    zeros = "0" * 64
    data = safetensors.torch.save(dict(tensors), {"head": json.dumps({**document, "sha256": zeros})})
    path.write_bytes(data.replace(zeros.encode(), hashlib.sha256(data).hexdigest().encode(), 1))
    return path
