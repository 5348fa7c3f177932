"""Runs in formats that other programs read. FORMATS is the registry; each format lives in one file."""

from __future__ import annotations

# A format is a function from an ExportSource to the steps that make its files, in order.
FORMATS: dict[str, str] = {
    "frames": "datagen.exports.frames:steps",
    "glb": "datagen.exports.glb:steps",
    "huggingface": "datagen.exports.huggingface:steps",
    "lerobot": "datagen.exports.lerobot:steps",
    "parquet": "datagen.exports.parquet:steps",
    "rerun": "datagen.exports.rerun_recording:steps",
    "webdataset": "datagen.exports.webdataset:steps",
}
