"""A zero-shot detector from a folder: real loading, forward pass and boxes of a tiny OWL-ViT made here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.baselines import make_baselines
from datagen.train.baselines.baseline import is_feasible
from datagen.train.baselines.detector import Detections, ZeroShotDetector, render_views, spoken_name
from tests.train.baselines.scenes import make_batch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a detector of random weights, as `save_pretrained` leaves them."""
    pytest.importorskip("transformers", reason="the extra `detect` is not installed")
    import torch
    from transformers import (
        CLIPTokenizer,
        OwlViTConfig,
        OwlViTForObjectDetection,
        OwlViTImageProcessor,
        OwlViTProcessor,
    )

    out = tmp_path_factory.mktemp("detector")
    letters = "abcdefghijklmnopqrstuvwxyz0123456789._-"
    words = [*letters, *(f"{c}</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    (out / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(words)}))
    (out / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizer(str(out / "vocab.json"), str(out / "merges.txt"), model_max_length=32)
    size = {"height": 32, "width": 32}
    OwlViTProcessor(OwlViTImageProcessor(size=size, crop_size=size), tokenizer).save_pretrained(out)
    small = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = {**small, "vocab_size": len(words), "max_position_embeddings": 32}
    tokens = {"bos_token_id": len(words) - 2, "eos_token_id": len(words) - 1, "pad_token_id": len(words) - 1}
    config = OwlViTConfig(
        text_config={**text, **tokens},
        vision_config={**small, "image_size": 32, "patch_size": 8},
        projection_dim=16,
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        OwlViTForObjectDetection(config).save_pretrained(out)
    return out


def test_boxes_of_every_frame_from_the_real_forward_pass(folder: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, 48, 64, 3)).astype(np.uint8)
    found = ZeroShotDetector(folder).detect(frames, "cracker box")
    assert len(found) == 3
    for detections in found:
        assert detections.boxes_px.shape == (16, 4) and detections.scores.shape == (16,)  # a box a patch
        assert ((detections.scores >= 0) & (detections.scores <= 1)).all()
        assert 0 <= detections.best_at_middle((48, 64)) <= detections.scores.max()
    again = ZeroShotDetector(folder).detect(frames[:1], "cracker box")[0]
    np.testing.assert_allclose(again.scores, found[0].scores, atol=1e-5)  # frames do not know of each other


def test_the_detector_sees_feasible_candidates_alone(folder: Path) -> None:
    (baseline,) = make_baselines(["threshold-detector"], detector=folder)
    assert baseline.name == "threshold-detector"
    batch = make_batch(4, n_scenes=1, per_robot=6)
    score = baseline.score(batch)
    feasible = is_feasible(batch)
    assert feasible.any() and not feasible.all()
    assert ((score[feasible] >= 0) & (score[feasible] <= 1)).all() and (score[~feasible] == -1).all()


def test_a_folder_without_a_detector_gives_one_line(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"config\.json"):
        ZeroShotDetector(tmp_path / "missing")
    for text in ('{"model_type": "bert"}', "{"):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(InputError, match="save_pretrained") as caught:
            ZeroShotDetector(tmp_path)
        assert "\n" not in str(caught.value)


def test_object_names_become_words() -> None:
    names = ("003_cracker_box", "mug", "063-a_marbles", "077")
    assert [spoken_name(name) for name in names] == ["cracker box", "mug", "a marbles", "077"]


def test_the_box_around_the_middle_counts() -> None:
    boxes = np.array([[0, 0, 10, 10], [20, 20, 60, 40], [0, 0, 64, 48]], float)
    scores = np.array([0.9, 0.5, 0.2])
    assert Detections(boxes, scores).best_at_middle((48, 64)) == 0.5
    assert Detections(boxes[:1], scores[:1]).best_at_middle((48, 64)) == 0
    assert Detections(np.zeros((0, 4)), np.zeros(0)).best_at_middle((48, 64)) == 0


def test_views_show_the_target_in_the_middle_the_right_way_up_and_near_points_before_far_ones() -> None:
    red, green, blue = rgb = np.eye(3, dtype=np.uint8) * 255
    eye = np.array([[1, 0, 0]], np.float32)
    points = np.array([[0.3, 0, 0], [0, 0, 0], [2, 0, 0]], np.float32)  # the last is behind the eye
    for order in ([0, 1, 2], [1, 0, 2]):
        (view,) = render_views(points[order], rgb[order], eye, 64)
        assert np.array_equal(view[32, 32], red) and not (view == blue).all(2).any()
    points = np.array([[0, 0, 0], [0, 0, 0.2], [0, 0.2, 0]], np.float32)
    (view,) = render_views(points, rgb, eye, 64)
    assert np.array_equal(view[32, 32], red)
    above, beside = (np.argwhere((view == c).all(2)).mean(0) for c in (green, blue))
    assert above[0] < 28 and abs(above[1] - 32) < 2
    assert beside[1] > 36 and abs(beside[0] - 32) < 2  # from +x, +y is to the right
    assert np.array_equal(view[0, 0], [127] * 3)
