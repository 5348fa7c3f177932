"""Base poses from arrays: the answer of the same frame in files, or one line of what is wrong with them."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import datagen
from tests.train.prediction.seen_scenes import Seen, camera_arrays, draw_seen

SIZES: dict[str, Any] = {"base_height": 0.7, "reach": 0.9, "allow_unseen": True}


@pytest.fixture(scope="module")
def seen() -> Seen:
    return draw_seen(0)


def test_arrays_give_the_answer_of_their_files(seen: Seen, made: Path) -> None:
    rgb, depth, K, T, mask = camera_arrays(seen)
    answer = datagen.find_base(rgb, depth, K, T, mask=mask, **SIZES)
    filed = datagen.predict(frame=[made / "posed"], **SIZES)
    np.testing.assert_allclose(answer.score, filed.score, atol=1e-6)
    assert answer.best == filed.best is not None
    metres = np.where(depth > 0, depth * 0.001, np.nan)
    again = datagen.find_base(rgb, metres, K, T, mask=mask, **SIZES)
    np.testing.assert_allclose(again.score, answer.score, atol=1e-6)
    assert repr(answer).startswith(f"Prediction({answer.level}: x ") and len(repr(answer)) < 100
    shown = answer._repr_png_()  # pyright: ignore[reportPrivateUsage]
    assert Image.open(BytesIO(shown)).size[0] > 500


def test_a_map_of_arrays_blocks(seen: Seen) -> None:
    rgb, depth, K, T, mask = camera_arrays(seen)
    x, y = T[:2, 3] - 6
    walls = datagen.OccupancyMap("map", np.full((240, 240), 100, np.int8), 0.05, (x, y, 0.0))
    answer = datagen.find_base(rgb, depth, K, T, mask=mask, map=walls, **SIZES)
    assert answer.best is None and len(answer.rows("blocked")) == 2601
    assert repr(answer) == "Prediction(none: no clear base pose was observed around the target)"


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"rgb": np.zeros((4, 4, 3))}, "rgb: is float64"),
        ({"depth": np.zeros((240, 320), np.int32)}, "depth: is int32"),
        ({"depth": np.zeros((3, 3), np.uint16)}, "rgb: is uint8"),
        ({"depth": np.zeros((240, 320), np.uint16)}, "no pixel has depth"),
        ({"K": np.eye(4)}, "K: is float64"),
        ({"K": np.zeros((3, 3))}, "K: has no focal"),
        ({"T": np.zeros((4, 4))}, "T_map_camera"),
        ({"T": None}, "--camera-height: is missing"),
        ({"mask": np.zeros((3, 3))}, "mask"),
        ({"mask": None}, "target: is not marked"),
    ],
)
def test_arrays_that_do_not_fit_are_named(seen: Seen, changed: dict[str, Any], named: str) -> None:
    given = dict(zip(("rgb", "depth", "K", "T", "mask"), camera_arrays(seen), strict=True)) | changed
    mask = given.pop("mask")
    with pytest.raises(datagen.InputError, match=named) as refused:
        datagen.find_base(*given.values(), mask=mask, **SIZES)
    assert "\n" not in str(refused.value)


def test_pictures_of_three_kinds(made: Path, tmp_path: Path) -> None:
    for ending, start in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        written = [tmp_path / f"{k}{ending}" for k in "ab"]
        for path in written:
            datagen.predict(frame=[made / "posed"], out=path, **SIZES)
        assert written[0].read_bytes().startswith(start)
        assert ending == ".svg" or written[0].read_bytes() == written[1].read_bytes()
