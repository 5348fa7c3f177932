"""Checkpoints of format 1: an old one still trains and predicts, and no pickle is believed or run."""

from __future__ import annotations

import os
import pickle
import shutil
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
from datagen.train.training.checkpoints import load_model, read_checkpoint
from tests.golden.archive import unpack
from tests.train.training.changed_checkpoints import is_refused_or_equal_with_a_byte_changed
from tests.train.training.small import TINY, equal, job_of, train_until

GOLDEN = Path(__file__).parents[2] / "golden"
OLD = GOLDEN / "checkpoint-format-1.ckpt"  # of the job below, interrupted in its third step


@pytest.fixture
def written() -> Path:
    return OLD


def test_torch_reads_the_same():
    stored, back = torch.load(OLD, weights_only=True), read_checkpoint(OLD)
    parts = {"weights": back.weights, "resume": back.resume}
    ours = {f"{part}/{name}": value for part, tensors in parts.items() for name, value in tensors.items()}
    assert equal(ours, {name: value for name, value in stored.items() if name != "head"})
    assert (back.head.step, back.head.epoch, back.loop["batch"]) == (3, 1, 1)
    assert not load_model(OLD)[0].training


def test_a_training_of_the_previous_version_resumes(tmp_path: Path):
    """It ends as one that was never interrupted."""
    unpack(GOLDEN / "run-format-2-schema-2.zip", tmp_path)
    val = tmp_path / "merged/parts/7dd3e367e63166c1"
    as_it_was = {**TINY, "hand_poses": 0, "observed_visibility": False}  # the defaults of its time
    ends: list[Path] = []
    for name in ("resumed", "whole"):
        out = tmp_path / name
        if name == "resumed":
            shutil.copy(OLD, out)
        job = job_of(tmp_path / "run", out, val, epochs=3, batch_scenes=1, model_config=as_it_was)
        assert train_until(job)[0]
        ends.append(out)
    resumed, whole = map(read_checkpoint, ends)
    assert resumed.head.step == whole.head.step == 6
    assert resumed.resume.keys() == whole.resume.keys()
    for name, tensor in whole.resume.items():
        # Equal to the last bit on the machine that wrote the old file.
        torch.testing.assert_close(resumed.resume[name], tensor, rtol=1e-3, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_changed_byte_is_detected_or_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
):
    path = tmp_path_factory.mktemp("changed") / "a.ckpt"
    is_refused_or_equal_with_a_byte_changed(OLD, path, data)


def test_a_truncated_file_gives_one_line(tmp_path: Path):
    data, cut = OLD.read_bytes(), tmp_path / "cut.ckpt"
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match="checkpoint") as error:
            read_checkpoint(cut)
        assert error.value.place == str(cut)


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
        with pytest.raises(InputError, match="not a datagen checkpoint"):
            read_checkpoint(path)


def test_an_unbounded_shape_is_refused(written: Path, tmp_path: Path):
    """Its strides are products over the shape, so that a million axes would take hours."""
    axes = b"K\x01" * 1_000_000

    def longer(data: bytes) -> bytes:
        at = data.index(b"K\x04\x85")  # BININT1 n, TUPLE1: the shape of a bias
        return data[:at] + b"(" + axes + b"t" + data[at + 3 :]

    with pytest.raises(InputError, match="a tensor of no shape"):
        read_checkpoint(with_pickle(tmp_path / "long.ckpt", written, longer))


def test_zip_bombs_are_refused_by_their_sizes(written: Path, tmp_path: Path):
    packed = tmp_path / "packed.ckpt"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("archive/data.pkl", b"\0" * 10_000_000)
    with pytest.raises(InputError, match="is compressed"):
        read_checkpoint(packed)


def test_pickles_that_would_never_end_are_refused(tmp_path: Path):
    nested = b"\x80\x02}(X\x04\x00\x00\x00headX\x00\x00\x00\x00)" + b"q\x00h\x00\x86" * 60
    for odd in (
        nested + b"K\x01u.",  # as a key, whose hash would take 2^60 steps
        b"\x80\x02ccollections\nOrderedDict\n(" + nested[3:] + b"K\x01utR.",
        b"\x80\x02}r\xff\xff\xff\xff.",  # an entry of the memo far beyond the others
        b"\x80\x02\x96\xff\xff\xff\xff\xff\xff\xff\x0f.",  # BYTEARRAY8
        b"\x80\x02J\xff\xff\xff\x7f" + b"\x85" * 100_000 + b".",
        b"\x80\x02}K\x01b.",  # BUILD
    ):
        path = with_pickle(tmp_path / "odd.ckpt", OLD, lambda _, odd=odd: odd)
        with pytest.raises(InputError, match="not a datagen checkpoint"):
            read_checkpoint(path)
