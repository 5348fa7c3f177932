"""Labelled robot base poses: make them, read them, train on them, and use the model on a robot.

This is the Python front door (docs/reference/python.md); the command line calls the same functions.
Importing it is cheap: each name is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from datagen.commands.evaluate import evaluate
    from datagen.commands.export import export
    from datagen.commands.find_base import find_base
    from datagen.commands.merge import merge
    from datagen.commands.predict import predict
    from datagen.commands.resume import resume
    from datagen.commands.submit import submit
    from datagen.commands.train import train_model
    from datagen.jobs.job_report import JobResult
    from datagen.schemas.errors import InputError
    from datagen.schemas.run import Run
    from datagen.sources import houses, label_sources, objects, robots
    from datagen.tables.candidates import candidates
    from datagen.tables.dataset import open_dataset
    from datagen.train.prediction.frames import SensorFrame
    from datagen.train.prediction.predict import load_scorer
    from datagen.train.torch_stream import TorchStream, stream
    from datagen.workers.occupancy_map import OccupancyMap

__all__ = [
    "InputError",
    "JobResult",
    "OccupancyMap",
    "Run",
    "SensorFrame",
    "TorchStream",
    "__version__",
    "candidates",
    "evaluate",
    "export",
    "find_base",
    "houses",
    "label_sources",
    "load_scorer",
    "merge",
    "objects",
    "open_dataset",
    "predict",
    "resume",
    "robots",
    "stream",
    "submit",
    "train_model",
]

_MODULES = {
    "datagen.commands.evaluate": ("evaluate",),
    "datagen.commands.export": ("export",),
    "datagen.commands.find_base": ("find_base",),
    "datagen.commands.merge": ("merge",),
    "datagen.commands.predict": ("predict",),
    "datagen.commands.resume": ("resume",),
    "datagen.commands.submit": ("submit",),
    "datagen.commands.train": ("train_model",),
    "datagen.jobs.job_report": ("JobResult",),
    "datagen.schemas.errors": ("InputError",),
    "datagen.schemas.run": ("Run",),
    "datagen.sources": ("houses", "label_sources", "objects", "robots"),
    "datagen.tables.candidates": ("candidates",),
    "datagen.tables.dataset": ("open_dataset",),
    "datagen.train.prediction.frames": ("SensorFrame",),
    "datagen.train.prediction.occupancy": ("OccupancyMap",),
    "datagen.train.prediction.predict": ("load_scorer",),
    "datagen.train.torch_stream": ("TorchStream", "stream"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            value = globals()[name] = getattr(_loaded(module), name)
            return value
    raise AttributeError(f"module 'datagen' has no attribute {name!r}. It offers: {', '.join(__all__)}")


def _loaded(module: str) -> Any:
    """Import the module. InputError for a missing library names the extra that has it."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        from datagen.workers.extras import missing_library

        if (missing := missing_library(error)) is None:
            raise
        raise missing from None


def __dir__() -> list[str]:
    return __all__
