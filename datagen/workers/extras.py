"""The libraries of each extra of the package, and how to install a missing one.

The package's name on a public index may belong to another project. The command therefore names the source
of this installation, or else the libraries themselves.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from datagen.schemas.errors import InputError

DISTRIBUTION = "base-placement-datagen"


@dataclass(frozen=True)
class Extra:
    """An extra of pyproject.toml."""

    gives: str
    brings: dict[str, str]  # import name -> name for pip

    def missing(self) -> list[str]:
        """The import names that are not installed; one with a hyphen is a distribution without modules."""
        absent = {name for name, found in versions_of(self.brings).items() if not found}
        return [n for n in self.brings if (n in absent if "-" in n else find_spec(n) is None)]


_FILES = {"matplotlib": "matplotlib", "PIL": "pillow", "scipy": "scipy", "yaml": "pyyaml"}

EXTRAS: dict[str, Extra] = {
    "labels": Extra(
        "heuristic labels; show, relabel, verify --replay",
        {"coacd": "coacd", "embreex": "embreex", "sapien": "sapien", "trimesh": "trimesh", **_FILES},
    ),
    "sim": Extra("plan and sim labels", {"coal": "coal", "numba": "numba", "mani_skill": "mani-skill"}),
    "robots": Extra(
        "robots stretch3, tiago-pro, ur5 and pr2; meshes in COLLADA",
        {
            "stretch_urdf": "hello-robot-stretch-urdf",
            "collada": "pycollada",
            "example-robot-data": "example-robot-data",
        },
    ),
    "predict": Extra(
        "predict with the released model, benchmark score of it, of files of scores and of rules",
        {"safetensors": "safetensors", **_FILES},
    ),
    "page": Extra("predict --html", {"plotly": "plotly"}),
    "serve": Extra("serve", {"fastapi": "fastapi", "uvicorn": "uvicorn"}),
    "train": Extra(
        "train, evaluate; predict with other models",
        {"torch": "torch", "numba": "numba", "safetensors": "safetensors", **_FILES},
    ),
    "ros": Extra("predict from recordings of ROS 2, goals as MCAP", {"rosbags": "rosbags"}),
    "cluster": Extra("workers of Ray: several processes, several machines", {"ray": "ray"}),
    "tables": Extra(
        "open_dataset and candidates: xarray and pandas", {"pandas": "pandas", "xarray": "xarray"}
    ),
    "export": Extra("export to parquet, huggingface and lerobot", {"av": "av", "pyarrow": "pyarrow"}),
    "rerun": Extra("export to rerun, view", {"pyarrow": "pyarrow", "rerun": "rerun-sdk"}),
    "pybullet": Extra("a second settler", {"pybullet": "pybullet"}),
}


def how_to_get(extra: str) -> str:
    """The sentence with the command that installs the missing libraries of an extra."""
    missing = EXTRAS[extra].missing()
    # On new versions of Python the extra lacks ManiSkill, which contains the robots' files.
    if missing == ["mani_skill"]:
        return "Install it: pip install --no-deps mani-skill"
    command = _from_origin(extra)
    if command is None:
        command = "pip install " + " ".join(EXTRAS[extra].brings[name] for name in missing)
    return f"Install the extra {extra}: {command}"


def refuse_missing(extra: str, otherwise: str = "") -> None:
    """Raise InputError where a library of the extra is not installed; `otherwise` is an alternative."""
    if missing := EXTRAS[extra].missing():
        fix = ", ".join(filter(None, (how_to_get(extra), otherwise)))
        raise InputError(", ".join(missing), "", "is not installed", fix)


def missing_library(error: Exception, preferred: str = "") -> InputError | None:
    """The error for a library of an extra that is not installed; None for any other exception.

    `preferred` is the extra to name if several contain the library.
    """
    lacking = error.__cause__ if isinstance(error.__cause__, ModuleNotFoundError) else error
    name = (lacking.name or "").partition(".")[0] if isinstance(lacking, ModuleNotFoundError) else ""
    # PackageNotFoundError holds the name of the distribution, not of the import.
    found = [key for key, extra in EXTRAS.items() if name in extra.brings or name in extra.brings.values()]
    if not found:
        return None
    extra = preferred if preferred in found else found[0]
    return InputError(name, "", "is not installed", how_to_get(extra))


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Installed versions of the names that are distributions; "" where not installed."""
    found: dict[str, str] = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    return found


def _from_origin(extra: str) -> str | None:
    """The pip command that adds an extra to this installation; None if its origin is unknown."""
    try:
        text = Distribution.from_name(DISTRIBUTION).read_text("direct_url.json")
        origin: Any = json.loads(text or "{}")
        url = str(origin["url"])
    except (PackageNotFoundError, ValueError, KeyError, TypeError):
        return None
    parts = urlsplit(url)
    if parts.scheme == "file":
        path = unquote(parts.path)
        editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
        return f"pip install {editable}{shlex.quote(f'{path}[{extra}]')}" if Path(path).exists() else None
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        url = f"{vcs.get('vcs', 'git')}+{url}@{vcs.get('commit_id', '')}".rstrip("@")
    return "pip install " + shlex.quote(f"{DISTRIBUTION}[{extra}] @ {url}")
