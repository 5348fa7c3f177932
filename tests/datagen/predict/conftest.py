"""A frame and a checkpoint for the tests of `datagen predict`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.datagen.predict.frames import HEIGHT_M
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import MODEL, draw_seen, write_frame


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a frame without and with its pose, and a checkpoint. Tests only read it."""
    folder = tmp_path_factory.mktemp("predict")
    seen = draw_seen(0)
    assert seen.height_m == pytest.approx(HEIGHT_M, abs=0.01)
    write_frame(folder / "frame", seen, posed=False)
    write_frame(folder / "posed", seen)
    write_untrained(folder / "model.ckpt", MODEL)
    return folder
