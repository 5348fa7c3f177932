"""Device and number of processes of a training."""

from __future__ import annotations

import torch

from datagen.schemas.errors import InputError


def choose_device(asked: str, processes: int | None) -> tuple[str, int]:
    """`cpu` or `cuda`, and the number of processes: as given, else one per GPU, or one.

    InputError where there are fewer GPUs than that.
    """
    gpus = torch.cuda.device_count() if asked != "cpu" and torch.cuda.is_available() else 0
    if asked == "cuda" and not gpus:
        raise InputError("datagen train", "--device", "torch finds no GPU", "Give --device cpu")
    if gpus and processes is not None and processes > gpus:
        problem = f"{processes} is more than {gpus} GPUs"
        raise InputError("datagen train", "--processes", problem, f"Give at most {gpus}, or --device cpu")
    return ("cuda" if gpus else "cpu"), processes or max(1, gpus)
