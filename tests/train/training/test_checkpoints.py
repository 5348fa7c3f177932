"""Checkpoints: written whole, read as data, and one line for what is none."""

from __future__ import annotations

import json
import os
import pickle
import signal
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.train.dataset import Origin
from datagen.train.models import build_model
from datagen.train.training.checkpoints import (
    Checkpoint,
    CheckpointHead,
    EpochRecord,
    load_model,
    only_writer,
    read_checkpoint,
    write_checkpoint,
)
from datagen.train.training.inert import MAX_BYTES
from tests.train.training.small import TINY, equal

ORIGIN: Origin = {
    "spec_hashes": ["b"], "schema": "sim", "schema_version": 2, "n_samples": 3, "n_scenes": 1,
    "samples_sha256": "a", "cost": {"cpu_s": 0.1},
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


def test_what_is_written_is_read(tmp_path: Path):
    checkpoint = checkpoint_of()
    path = tmp_path / "new/folder/a.ckpt"
    write_checkpoint(path, checkpoint)
    back = read_checkpoint(path)
    assert back.head == checkpoint.head
    assert back.loop == checkpoint.loop
    assert equal(back.weights, checkpoint.weights)
    assert equal(back.resume, checkpoint.resume)
    assert [p.name for p in path.parent.iterdir()] == ["a.ckpt"]
    model, head = load_model(path)
    assert not model.training
    assert equal(model.state_dict(), checkpoint.weights)
    assert head.digest == back.head.digest
    assert len(head.digest) == 64


def test_torch_alone_reads_it(written: Path):
    stored = torch.load(written, weights_only=True)
    assert json.loads(stored["head"])["format"] == "datagen checkpoint"
    assert isinstance(stored["weights/token.0.weight"], torch.Tensor)


def test_loading_draws_nothing_from_the_global_generator(written: Path):
    torch.manual_seed(7)
    load_model(written)
    after = torch.rand(3)
    torch.manual_seed(7)
    assert torch.equal(torch.rand(3), after)


def test_a_file_cut_anywhere_is_one_line(written: Path, tmp_path: Path):
    data = written.read_bytes()
    cut = tmp_path / "cut.ckpt"
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match="checkpoint") as error:
            read_checkpoint(cut)
        assert error.value.place == str(cut)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_changed_byte_is_noticed_or_changes_nothing(written: Path, data: st.DataObject):
    whole = read_checkpoint(written)
    stored = bytearray(written.read_bytes())
    at = data.draw(st.integers(0, len(stored) - 1))
    stored[at] ^= data.draw(st.integers(1, 255))
    path = written.with_name("changed.ckpt")
    path.write_bytes(bytes(stored))
    try:
        back = read_checkpoint(path)
    except InputError:
        return
    assert back.head == whole.head
    assert equal(back.weights, whole.weights)
    assert equal(back.resume, whole.resume)


class Attack:
    """Unpickling it would leave a file."""

    def __init__(self, canary: Path) -> None:
        self._canary = canary

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return os.mkdir, (str(self._canary),)


def with_pickle(path: Path, source: Path, new: Callable[[bytes], bytes]) -> Path:
    """The checkpoint with another pickle in it; every checksum is right."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as out:
        for record in old.infolist():
            data = old.read(record)
            out.writestr(record.filename, new(data) if record.filename.endswith("data.pkl") else data)
    return path


def test_foreign_pickles_are_never_run(written: Path, tmp_path: Path):
    canary = tmp_path / "canary"
    attack = pickle.dumps({"head": Attack(canary)}, protocol=2)
    bare, inside, torch_made = tmp_path / "bare", tmp_path / "inside", tmp_path / "torch"
    bare.write_bytes(attack)
    with_pickle(inside, written, lambda _: attack)
    torch.save({"head": Attack(canary)}, torch_made)
    for path in (bare, inside, torch_made):
        with pytest.raises(InputError, match="checkpoint") as error:
            load_model(path)
        assert "\n" not in str(error.value)
    assert not canary.exists()
    torch.load(torch_made, weights_only=False)  # the attack is one
    assert canary.exists()


def test_declared_sizes_must_be_those_of_the_file(written: Path, tmp_path: Path):
    """Some releases of torch believe a pickle that a record is larger than it is, and read beyond it."""
    (n,) = torch.load(written, weights_only=True)["weights/token.1.bias"].shape
    assert n == TINY["width"]

    def larger(data: bytes) -> bytes:
        # BININT1 n, as count of a storage and as shape; the first is that of a storage of n floats.
        at = data.index(b"K\x04t")
        return data[: at + 1] + b"\x40" + data[at + 2 :]

    path = with_pickle(tmp_path / "larger.ckpt", written, larger)
    with pytest.raises(InputError, match="of another size"):
        read_checkpoint(path)
    for word in (b"\x8c\x01a", b"c__builtin__\neval\n", b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f"):
        path = with_pickle(tmp_path / "odd.ckpt", written, lambda data, w=word: data[:2] + w + data[2:])
        with pytest.raises(InputError, match="not a checkpoint"):
            read_checkpoint(path)


def test_a_shape_without_end_is_refused(written: Path, tmp_path: Path):
    """Its strides are products over the shape, so that a million axes would take hours."""
    axes = b"K\x01" * 1_000_000

    def longer(data: bytes) -> bytes:
        at = data.index(b"K\x04\x85")  # BININT1 n, TUPLE1: the shape of a bias
        return data[:at] + b"(" + axes + b"t" + data[at + 3 :]

    with pytest.raises(InputError, match="a tensor of no shape"):
        read_checkpoint(with_pickle(tmp_path / "long.ckpt", written, longer))


def test_bombs_are_refused_by_their_sizes(written: Path, tmp_path: Path):
    packed = tmp_path / "packed.ckpt"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("archive/data.pkl", b"\0" * 10_000_000)
    with pytest.raises(InputError, match="is compressed"):
        read_checkpoint(packed)
    sparse = tmp_path / "sparse.ckpt"
    with open(sparse, "wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="more than the"):
        read_checkpoint(sparse)


def test_what_is_no_checkpoint_is_named(tmp_path: Path):
    model = build_model("shared", TINY).state_dict()
    plain, listed, newer = tmp_path / "plain.pt", tmp_path / "list.pt", tmp_path / "newer.ckpt"
    torch.save(model, plain)
    torch.save([1, 2], listed)
    torch.save({"head": json.dumps({"format": "datagen checkpoint", "format_version": 2})}, newer)
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    cases = [
        (plain, "not a datagen checkpoint"),
        (listed, "not a datagen checkpoint"),
        (newer, "format_version: is 2, but this program reads 1. Use the version"),
        (tmp_path, "not a file"),
        (fifo, "not a file"),
        (tmp_path / "none", "No such file"),
    ]
    for path, words in cases:
        with pytest.raises(InputError, match=words) as error:
            load_model(path)
        assert error.value.place == str(path)


def test_weights_that_do_not_fit_are_named(tmp_path: Path):
    whole = checkpoint_of()
    name = next(iter(whole.weights))
    cases: list[tuple[Checkpoint, str]] = [
        (
            Checkpoint(whole.head, {k: v for k, v in whole.weights.items() if k != name}),
            "the checkpoint lacks it",
        ),
        (
            Checkpoint(whole.head, {**whole.weights, "more": torch.zeros(1)}),
            "more: the model has no such weights",
        ),
        (Checkpoint(whole.head, {**whole.weights, name: torch.zeros(1)}), f"{name}: .* in the model"),
        (Checkpoint(head_of(model="none"), whole.weights), "is unknown"),
        (Checkpoint(head_of(model_config={"width": 10**9}), whole.weights), "width"),
        (Checkpoint(head_of(epoch="x"), whole.weights), "epoch"),
        (Checkpoint(head_of(data=({"schema": "sim"},)), whole.weights), "spec_hashes"),
        (Checkpoint(head_of(history=({"epoch": 1},)), whole.weights), "val_loss"),
    ]
    for checkpoint, words in cases:
        write_checkpoint(tmp_path / "c.ckpt", checkpoint)
        with pytest.raises(InputError, match=words):
            load_model(tmp_path / "c.ckpt")


def stored_with(path: Path, source: Path, **changes: Any) -> Path:
    """The checkpoint with other entries, as torch alone writes it."""
    torch.save({**torch.load(source, weights_only=True), **changes}, path)
    return path


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_are_not_finite_are_refused(written: Path, tmp_path: Path, value: float):
    name = "token.1.bias"
    bias = torch.load(written, weights_only=True)[f"weights/{name}"]
    bias[-1] = value
    for key in (f"weights/{name}", "weights/token.1.running_var", f"resume/{name}"):
        path = stored_with(tmp_path / "bad.ckpt", written, **{key: bias})
        with pytest.raises(InputError, match=f"{key}: holds NaN or infinite numbers"):
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
    document = json.loads(torch.load(written, weights_only=True)["head"])
    texts = ["\ud800", "a\0b", "a\nb", "\x1b[31m", "a" * 5000]
    numbers: list[Any] = [float("nan"), float("inf"), 10**400, -(10**20)]
    changes: list[tuple[str, str, Any]] = [("head", "stage", value) for value in texts]
    changes += [("head", "house_ids", [value]) for value in texts]
    changes += [("head", "options", {value: 1}) for value in texts]
    changes += [("head", "cost", {"train_cpu_s": value}) for value in numbers]
    changes += [("head", "options", {"deep": [[{"lr": value}]]}) for value in numbers]
    changes += [("loop", "sums", [value, 0.0, 0.0, 0.0]) for value in numbers]
    for part, field, value in changes:
        text = json.dumps({**document, part: {**document[part], field: value}})
        with pytest.raises(
            InputError, match=r"not a usable number|control characters or surrogates"
        ) as error:
            read_checkpoint(stored_with(tmp_path / "odd.ckpt", written, head=text))
        assert f"{part}.{field}" in error.value.field
        str(error.value).encode()


@pytest.mark.parametrize("at", ["fsync", "replace"])
def test_killed_while_it_is_written_the_old_file_is_whole(tmp_path: Path, at: str):
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
    write_checkpoint(path, checkpoint_of(step=3))
    assert read_checkpoint(path).head.step == 3
    assert [p.name for p in tmp_path.iterdir()] == ["c.ckpt"]


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "c.ckpt"
    write_checkpoint(path, checkpoint_of(step=1))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_checkpoint(path, checkpoint_of(step=2))
    assert read_checkpoint(path).head.step == 1
    assert [p.name for p in tmp_path.iterdir()] == ["c.ckpt"]


def test_one_process_at_a_time_writes_it(tmp_path: Path):
    path = tmp_path / "c.ckpt"
    with only_writer(path), only_writer(tmp_path / "other.ckpt"):
        with (
            pytest.raises(InputError, match=r"c\.ckpt: is being trained by another process"),
            only_writer(path),
        ):
            pass
        with pytest.raises(InputError), only_writer(path):
            pass
    with only_writer(path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_view_is_kept_without_what_it_is_a_view_of(tmp_path: Path):
    large = torch.zeros(1_000_000)
    write_checkpoint(tmp_path / "c.ckpt", Checkpoint(head_of(), {"w": large[:3]}))
    assert (tmp_path / "c.ckpt").stat().st_size < 100_000
