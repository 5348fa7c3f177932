"""Checkpoints: written whole, read as data, and one line for what is none."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from torch import Tensor

from datagen.schemas.errors import InputError
from datagen.train.dataset import DataOrigin
from datagen.train.models import build_model
from datagen.train.training.checkpoints import (
    MAX_BYTES,
    Checkpoint,
    CheckpointHead,
    EpochRecord,
    load_model,
    only_writer,
    read_checkpoint,
    write_checkpoint,
)
from tests.train.prediction.checkpoints import document_of, signed, stored_with
from tests.train.training.small import TINY, equal

ORIGIN: DataOrigin = {
    "spec_hashes": ["b"], "schema": "sim", "schema_version": 2, "n_samples": 3, "n_scenes": 1,
    "samples_sha256": "a", "cost": {"cpu_s": 0.1}, "robots": {"arm_reach_m": [0.3, 1.0]},
}  # fmt: skip
EPOCH: EpochRecord = {
    "epoch": 1, "step": 2, "loss": 0.4, "accuracy": 0.5,
    "val_loss": 0.1 + 0.2, "val_accuracy": 1.0, "val_balanced_accuracy": None, "val_auc": None,
}  # fmt: skip


def head_of(**changes: Any) -> CheckpointHead:
    fields: dict[str, Any] = {
        "model": "shared", "model_config": build_model("shared", TINY).config, "stage": "stage1",
        "options": {"lr": 1e-3}, "data": (ORIGIN,), "val_data": (), "house_ids": ("h1",),
        "object_digests": (), "val_house_ids": ("h3",), "cost": {"train_cpu_s": 0.1}, "versions": {},
        "history": (EPOCH,),
    }  # fmt: skip
    return CheckpointHead(**{**fields, **changes})


def checkpoint_of(**changes: Any) -> Checkpoint:
    model = build_model("shared", TINY)
    resume = {"model.a": torch.arange(6).reshape(2, 3).T, "optimiser.0.step": torch.tensor(3.0)}
    return Checkpoint(head_of(**changes), model.state_dict(), resume, {"batch": 2, "sums": [0.1, 1e-300]})


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "a.ckpt"
    write_checkpoint(path, checkpoint_of())
    return path


def test_written_checkpoints_are_read_back(tmp_path: Path):
    checkpoint = checkpoint_of()
    path = tmp_path / "new/folder/a.ckpt"
    write_checkpoint(path, checkpoint)
    back = read_checkpoint(path)
    assert back.head == checkpoint.head
    assert back.loop == checkpoint.loop
    assert equal(back.weights, checkpoint.weights)
    assert equal(back.resume, checkpoint.resume)
    assert [p.name for p in path.parent.iterdir()] == ["a.ckpt"]
    with safe_open(path, "pt") as stored:  # safetensors alone reads it, too
        assert json.loads(stored.metadata()["head"])["format"] == "datagen checkpoint"
        assert stored.get_tensor("weights/token.0.weight").dtype == torch.float32
    state = torch.get_rng_state()
    model, head = load_model(path)
    assert torch.equal(torch.get_rng_state(), state)
    assert not model.training
    assert equal(model.state_dict(), checkpoint.weights)
    assert head.digest == back.head.digest
    assert len(head.digest) == 64
    # A view is saved without its base tensor.
    write_checkpoint(path, Checkpoint(head_of(), {"w": torch.zeros(1_000_000)[:3]}))
    assert path.stat().st_size < 100_000


def test_a_truncated_file_gives_one_line(written: Path, tmp_path: Path):
    data = written.read_bytes()
    cut = tmp_path / "cut.ckpt"
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match="checkpoint") as error:
            read_checkpoint(cut)
        assert error.value.place == str(cut)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_changed_byte_is_detected_or_changes_nothing(written: Path, data: st.DataObject):
    whole, path = read_checkpoint(written), written.with_name("changed.ckpt")
    stored = bytearray(written.read_bytes())
    stored[data.draw(st.integers(0, len(stored) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(bytes(stored))
    try:
        back = read_checkpoint(path)
    except InputError:
        return
    assert back.head == whole.head
    assert equal(back.weights, whole.weights)
    assert equal(back.resume, whole.resume)


def with_header(path: Path, source: Path, changed: Callable[[dict[str, Any]], None]) -> Path:
    """The checkpoint with another header, signed anew."""
    data = source.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    stated = json.loads(header["__metadata__"]["head"])["sha256"]
    changed(header)
    text = json.dumps(header).replace(stated, "0" * 64).encode()
    unsigned = struct.pack("<Q", len(text)) + text + data[end:]
    path.write_bytes(unsigned.replace(b"0" * 64, hashlib.sha256(unsigned).hexdigest().encode(), 1))
    return path


def test_declared_sizes_must_be_those_of_the_file(written: Path, tmp_path: Path):
    """Also in a file whose checksum is right."""
    name = "weights/token.1.bias"
    assert read_checkpoint(with_header(tmp_path / "same", written, lambda _: None)).head

    changes: list[dict[str, Any]] = [
        {"shape": [2**62]}, {"shape": [2**62, 2**62]}, {"shape": [-1]}, {"shape": []}, {"shape": [4.0]},
        {"shape": [1] * 1_000_000}, {"dtype": "F64"}, {"dtype": "I32"}, {"dtype": 3}, {"dtype": []},
        {"data_offsets": [0, 2**60]}, {"data_offsets": [2**60, 2**60 + 16]}, {"data_offsets": [-16, 0]},
        {"data_offsets": [0, 16]},  # those of another tensor
    ]  # fmt: skip
    for change in changes:
        path = with_header(tmp_path / "odd", written, lambda header, c=change: header[name].update(c))
        with pytest.raises(InputError, match="not a datagen checkpoint, or damaged") as error:
            read_checkpoint(path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 600
    for header in (b"[]", b"3", b'"x"', b"{}", b'{"__metadata__": 3}', b"[" * 100_000, b"\xff\xfe"):
        path.write_bytes(struct.pack("<Q", len(header)) + header)
        with pytest.raises(InputError, match="not a datagen checkpoint, or damaged"):
            read_checkpoint(path)


def test_files_are_refused_by_their_sizes(written: Path, tmp_path: Path):
    sparse = tmp_path / "sparse.ckpt"
    with open(sparse, "wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="more than the"):
        read_checkpoint(sparse)
    for length in (2**40, 2**63, 2**25 + 1):
        sparse.write_bytes(struct.pack("<Q", length) + written.read_bytes()[8:])
        with pytest.raises(InputError, match="no header of a safetensors file"):
            read_checkpoint(sparse)


def test_files_that_are_no_checkpoints_are_named(tmp_path: Path):
    model = build_model("shared", TINY).state_dict()
    torch.save(model, tmp_path / "plain.pt")
    torch.save([1, 2], tmp_path / "list.pt")
    safetensors.torch.save_file(model, tmp_path / "foreign")
    (tmp_path / "zeros").write_bytes(bytes(100))
    signed(tmp_path / "newer", {}, {"format": "datagen checkpoint", "format_version": 3})
    os.mkfifo(tmp_path / "fifo")
    cases = [
        *((name, "not a datagen checkpoint") for name in ("plain.pt", "list.pt", "foreign", "zeros")),
        ("newer", "format_version: is 3, but this program reads 2. Use the version"),
        (".", "not a file"),
        ("fifo", "not a file"),
        ("none", "No such file"),
    ]
    for name, words in cases:
        with pytest.raises(InputError, match=words) as error:
            load_model(tmp_path / name)
        assert error.value.place == str(tmp_path / name)


def test_weights_that_do_not_fit_are_named(tmp_path: Path):
    whole = checkpoint_of()
    name = next(iter(whole.weights))
    lacking = {k: v for k, v in whole.weights.items() if k != name}
    cases: list[tuple[dict[str, Any], Mapping[str, Tensor], str]] = [
        ({}, lacking, "the checkpoint lacks it"),
        ({}, {**whole.weights, "more": torch.zeros(1)}, "more: the model has no such weights"),
        ({}, {**whole.weights, name: torch.zeros(1)}, f"{name}: .* in the model"),
        ({"model": "none"}, whole.weights, "is unknown"),
        ({"model_config": {"width": 10**9}}, whole.weights, "width"),
        ({"epoch": "x"}, whole.weights, "epoch"),
        ({"data": ({"schema": "sim"},)}, whole.weights, "spec_hashes"),
        ({"history": ({"epoch": 1},)}, whole.weights, "val_loss"),
    ]
    for changes, weights, words in cases:
        write_checkpoint(tmp_path / "c.ckpt", Checkpoint(head_of(**changes), weights))
        with pytest.raises(InputError, match=words):
            load_model(tmp_path / "c.ckpt")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_are_not_finite_are_refused(written: Path, tmp_path: Path, value: float):
    name = "token.1.bias"
    bias = safetensors.torch.load_file(written)[f"weights/{name}"]
    bias[-1] = value
    for key in (f"weights/{name}", "weights/token.1.running_var", f"resume/{name}"):
        path = stored_with(tmp_path / "bad.ckpt", written, {key: bias})
        with pytest.raises(InputError, match=f"{key}: has NaN or infinite numbers"):
            load_model(path)
    whole = read_checkpoint(written)
    path = tmp_path / "kept.ckpt"
    write_checkpoint(path, whole)
    before = path.read_bytes()
    for weights, resume in (({name: bias}, {}), (whole.weights, {"model.x": bias})):
        with pytest.raises(InputError, match="Nothing was overwritten"):
            write_checkpoint(path, Checkpoint(whole.head, weights, resume))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir() if p.name != "bad.ckpt"] == ["kept.ckpt"]


def test_every_text_and_number_of_the_document_is_checked(written: Path, tmp_path: Path):
    document = document_of(written)
    texts = ["\ud800", "a\0b", "a\nb", "\x1b[31m", "a" * 5000]
    numbers: list[Any] = [float("nan"), float("inf"), 10**400, -(10**20)]
    changes: list[tuple[str, str, Any]] = [("head", "stage", value) for value in texts]
    changes += [("head", "house_ids", [value]) for value in texts]
    changes += [("head", "options", {value: 1}) for value in texts]
    changes += [("head", "cost", {"train_cpu_s": value}) for value in numbers]
    changes += [("head", "options", {"deep": [[{"lr": value}]]}) for value in numbers]
    changes += [("loop", "sums", [value, 0.0, 0.0, 0.0]) for value in numbers]
    for part, field, value in changes:
        changed = {part: {**document[part], field: value}}
        with pytest.raises(
            InputError, match=r"not a usable number|control characters or surrogates"
        ) as error:
            read_checkpoint(stored_with(tmp_path / "odd.ckpt", written, **changed))
        assert f"{part}.{field}" in error.value.field
        str(error.value).encode()


@pytest.mark.parametrize("at", ["fsync", "replace"])
def test_a_kill_or_a_full_disk_during_writing_keeps_the_old_file(
    tmp_path: Path, at: str, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "c.ckpt"
    write_checkpoint(path, checkpoint_of(step=1))
    before = path.read_bytes()
    child = os.fork()
    if child == 0:
        setattr(os, at, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        write_checkpoint(path, checkpoint_of(step=2))
        os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    assert path.read_bytes() == before
    with monkeypatch.context() as full:
        full.setattr(os, at, Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(OSError, match="No space"):
            write_checkpoint(path, checkpoint_of(step=2))
    assert path.read_bytes() == before
    write_checkpoint(path, checkpoint_of(step=3))
    assert read_checkpoint(path).head.step == 3
    assert [p.name for p in tmp_path.iterdir()] == ["c.ckpt"]


def test_one_process_at_a_time_writes_it(tmp_path: Path):
    path = tmp_path / "c.ckpt"
    busy = pytest.raises(InputError, match=r"c\.ckpt: is being trained by another process")
    with only_writer(path), only_writer(tmp_path / "other.ckpt"):
        for _ in range(2):
            with busy, only_writer(path):
                pass
    with only_writer(path):
        pass
    assert not list(tmp_path.iterdir())
