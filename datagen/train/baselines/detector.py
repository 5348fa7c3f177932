"""Zero-shot object detectors. Only this module imports transformers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, U8
from datagen.workers.extras import how_to_get


@dataclass(frozen=True, eq=False)
class Detections:
    """K boxes of one image."""

    boxes_px: F64  # (K, 4) left, top, right, bottom
    scores: F64  # (K,) in [0, 1]

    def best_at_middle(self, shape: Sequence[int]) -> float:
        """The highest score of the boxes around the centre of an image (H, W), or 0."""
        y, x = shape[0] / 2, shape[1] / 2
        left, top, right, bottom = self.boxes_px.reshape(-1, 4).T
        holds = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
        return float(self.scores[holds].max(initial=0.0))


class ZeroShotDetector:
    """A zero-shot detector of transformers (OWL-ViT, OWLv2, Grounding DINO) from a local folder."""

    def __init__(self, folder: str | Path, device: str = "cpu") -> None:
        where = Path(folder)
        if not (where / "config.json").is_file():
            fix = "Name a folder that holds a detector's config.json, weights and processor"
            raise InputError(where, "config.json", "is not in the folder of a detector", fix)
        try:
            from transformers import AutoModelForZeroShotObjectDetection, AutoProcessor
        except ImportError as error:
            fix = how_to_get("detect")
            raise InputError("--detector", "transformers", f"not usable ({error})", fix) from None
        try:
            self._processor: Any = AutoProcessor.from_pretrained(where, local_files_only=True)
            model: Any = AutoModelForZeroShotObjectDetection.from_pretrained(
                where, local_files_only=True, use_safetensors=True
            )
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            fix = "Save model and processor into it again with `save_pretrained`"
            raise InputError(where, "", f"is not a zero-shot detector: {error}", fix) from None
        self._model = model.to(device).eval()
        self._device = device

    def detect(self, frames: U8, label: str) -> list[Detections]:
        """All boxes of each frame (B, H, W, 3), whatever their score."""
        import torch

        # Grounding DINO was trained with lower case and a full stop; OWL-ViT accepts both forms.
        words = [[f"a photo of a {label.lower()}."]] * len(frames)
        with torch.inference_mode():
            inputs = self._processor(images=list(frames), text=words, return_tensors="pt", padding=True)
            inputs = inputs.to(self._device)
            outputs = self._model(**inputs)
        sizes = [frame.shape[:2] for frame in frames]
        ids = {"input_ids": inputs["input_ids"], "text_threshold": 0.0} if _needs_ids(self._processor) else {}
        found = self._processor.post_process_grounded_object_detection(
            outputs, threshold=0.0, target_sizes=sizes, **ids
        )
        return [
            Detections(f["boxes"].double().cpu().numpy(), f["scores"].double().cpu().numpy()) for f in found
        ]


def _needs_ids(processor: Any) -> bool:
    """Whether the processor needs the tokens: Grounding DINO's finds the words of a box in them."""
    from inspect import signature

    return "input_ids" in signature(processor.post_process_grounded_object_detection).parameters
