"""A checkpoint with one byte changed, of either format."""

from __future__ import annotations

from pathlib import Path

from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.train.training.checkpoints import read_checkpoint
from tests.train.training.small import equal


def is_refused_or_equal_with_a_byte_changed(source: Path, changed: Path, data: st.DataObject) -> None:
    """One drawn byte of a checkpoint, changed, leads to an InputError or to the same contents."""
    whole = read_checkpoint(source)
    stored = bytearray(source.read_bytes())
    at = data.draw(st.integers(0, len(stored) - 1))
    stored[at] ^= data.draw(st.integers(1, 255))
    changed.write_bytes(bytes(stored))
    try:
        back = read_checkpoint(changed)
    except InputError:
        return
    assert back.head == whole.head
    assert equal(back.weights, whole.weights)
    assert equal(back.resume, whole.resume)
