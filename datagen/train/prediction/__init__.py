"""Predict a base pose from a real frame: floor, target, and scores of base poses around it."""

from __future__ import annotations

from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import RobotSize
from datagen.train.prediction.footprints import Footprint, read_footprint
from datagen.train.prediction.frames import read_frame, read_place
from datagen.train.prediction.occupancy import KnownFloor
from datagen.train.prediction.predict import load_scorer, predict
from datagen.workers.occupancy_map import OccupancyMap, read_map

__all__ = [
    "Footprint",
    "KnownFloor",
    "OccupancyMap",
    "Prediction",
    "RobotSize",
    "load_scorer",
    "predict",
    "read_footprint",
    "read_frame",
    "read_map",
    "read_place",
]
