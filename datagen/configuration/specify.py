"""Make a specification and a layout from options and a TOML file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.configuration.arms import (
    ARM_PACKAGES,
    arm_versions,
    complete_arm,
    narrow_candidates,
    refuse_unsuited,
    robot_of,
)
from datagen.schemas.errors import InputError, choices
from datagen.schemas.run_records import Layout
from datagen.schemas.specification import Source, Specification
from datagen.schemas.untrusted_files import read_regular
from datagen.workers.houses.house import HouseSource
from datagen.workers.labels import load_label_source
from datagen.workers.objects.model import ObjectSource
from datagen.workers.rendering import RENDERERS, load_renderer
from datagen.workers.robots import robot_limits
from datagen.workers.scenes import scenes_version
from datagen.workers.settling import SETTLERS, first_settler, load_settler

Options = Mapping[str, Any]  # by dotted name in the specification; None where not given

_MAX_CONFIG_BYTES = 1 << 20
_MAX_DEPTH = 16
# Distributions whose version can change bits of a sample, by the engine that needs them.
_ENGINE_PACKAGES = {"sapien": "sapien", "pybullet": "pybullet", "embree": "embreex"}
_SCENES_PER_SHARD = 32
_SHARDS_AT_LEAST = 8


def specify(
    label_source: str,
    houses: HouseSource,
    objects: ObjectSource,
    options: Options,
    config: Path | None,
    robot: str | None = None,
    repeats: int | None = None,
) -> Specification:
    """Return the specification of the options (dotted names, None where not given) and the file.

    An option overrides the file, and the file the default. `robot` and `repeats` are --robot and --perturb.
    Raises InputError for an option, for a field of the file, and for an engine that cannot be imported here.
    """
    place = str(config) if config else "options"
    fields = read_fields(config)
    for name, value in options.items():
        if value is not None:
            put_field(fields, name, value, config)
    settle = fields.setdefault("settle", {})
    if isinstance(settle, dict):
        # SAPIEN where it can be imported, else the first that can; the choice is recorded.
        settle.setdefault("engine", first_settler())
    complete_arm(label_source, fields, robot, repeats, place)
    chosen = robot_of(fields, robot)
    if chosen is not None:
        narrow_candidates(fields, chosen)
    candidates = fields.setdefault("candidates", {})
    if isinstance(candidates, dict):
        # A robot with a mobile base of its own has the same one at every reach.
        if chosen is None or robot_limits(chosen).base_radius_m is None:
            candidates.setdefault("scaled_base", True)
        if label_source in ARM_PACKAGES and "within" not in candidates:
            candidates.setdefault("per_scene", "grid")
        if candidates.get("per_scene") == "grid":
            # The cells of a whole grid are ranked against each other, so they have one robot.
            candidates.setdefault("robots_per_scene", 1)
    fields |= {
        "label_source": label_source,
        "houses": Source(kind=houses.kind, digest=houses.digest),
        "objects": Source(kind=objects.kind, digest=objects.digest),
    }
    spec = validated(fields, place)
    if spec.candidates.per_scene == "grid" and spec.candidates.within is not None:
        problem = f"a whole grid has cells that are not {spec.candidates.within}"
        raise InputError(place, "candidates.within", problem, "Give --candidates-per-scene 60")
    if chosen is not None:
        refuse_unsuited(spec, chosen, place, "Correct the values, or choose another --robot")
    for option, field, name, registry in (
        ("--settler", "settle.engine", spec.settle.engine, SETTLERS),
        ("--renderer", "observation.renderer", spec.observation.renderer, RENDERERS),
    ):
        if name not in registry:
            given = option if options.get(field) == name else place
            raise InputError(given, field, f"{name!r} is unknown", choices(registry, name))
    load_settler(spec.settle.engine)
    load_renderer(spec.observation.renderer)
    return spec.model_copy(update={"engines": scene_engines(spec) | label_engines(spec.label_source)})


def read_fields(config: Path | None) -> dict[str, Any]:
    """The fields of the file. Raises InputError for those that only the command line may set."""
    fields = read_toml(config) if config else {}
    for reserved in ("label_source", "houses", "objects", "engines", "scenes_from"):
        if reserved in fields:
            raise InputError(
                config or "", reserved, "cannot be set in this file", "Give it on the command line instead"
            )
    return fields


def validated(fields: dict[str, Any], place: str) -> Specification:
    """The specification of these fields. Raises InputError for the first that is wrong."""
    try:
        return Specification.model_validate(fields)
    except ValidationError as error:
        raise first_of(error, place) from None


def first_of(error: ValidationError, place: str, *section: str) -> InputError:
    """The InputError for the first wrong field of a file, or of a section of it."""
    first = error.errors()[0]
    field = ".".join((*section, *map(str, first["loc"])))
    fix = (
        "Remove or correct the key: docs/reference/specification.md lists all"
        if (first["type"] == "extra_forbidden")
        else "Correct the value"
    )
    return InputError(place, field, f"{first['msg']} (given: {str(first['input'])[:80]})", fix)


def layout_of(spec: Specification, n: int) -> Layout:
    """The layout: shards of about 32 scenes, or fewer in a small run, so that workers share it evenly.

    A number of scenes that divides evenly is preferred, so that no label beyond n is made.
    """
    scenes = -(-n // spec.candidates.count)
    most = max(1, min(_SCENES_PER_SHARD, scenes // _SHARDS_AT_LEAST))
    even = next((k for k in range(most, most // 2, -1) if scenes % k == 0), most)
    return Layout(scenes_per_shard=even, candidates_per_scene=spec.candidates.count)


def scene_engine_names(spec: Specification) -> set[str]:
    """Names in `engines` of what can change bits of the scenes and candidates of this specification."""
    used = (spec.settle.engine, spec.observation.renderer)
    return {"scenes", *(_ENGINE_PACKAGES[name] for name in used)}


def label_engines(label_source: str) -> dict[str, str]:
    """Versions of what can change bits of labels, and of the random streams of scenes and labels."""
    return {
        _ENGINE_PACKAGES["embree"]: version(_ENGINE_PACKAGES["embree"]),
        # numpy may change what a generator draws between feature releases, never between patches.
        "numpy": ".".join(version("numpy").split(".")[:2]),
        "labels": str(load_label_source(label_source).version),
        **arm_versions(label_source),
    }


def scene_engines(spec: Specification) -> dict[str, str]:
    """Versions on this machine of what can change bits of the scenes and candidates."""
    packages = sorted(scene_engine_names(spec) - {"scenes"})
    return {name: version(name) for name in packages} | {"scenes": str(scenes_version(spec))}


def read_toml(
    path: Path, fix: str = "Give a TOML file as in docs/reference/specification.md"
) -> dict[str, Any]:
    """The content of a TOML file. InputError, with `fix`, where it is not TOML, too large or unreadable."""
    data = read_regular(path, _MAX_CONFIG_BYTES, fix)
    try:
        return parse_toml(data.decode())
    except ValueError as error:
        raise InputError(path, "", f"is not TOML: {error}", fix) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of TOML text. ValueError where it is not TOML, or nested too deeply."""
    # The parser's memory grows with the square of the number of parts of a dotted key.
    if any(line.count(".") > 1000 for line in text.splitlines()):
        raise ValueError("nested too deeply: more than 1000 dots in a line")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level: list[Any] = [document]
    for _ in range(_MAX_DEPTH):  # dotted keys nest without brackets, beyond the recursion limit
        tables = [value.values() if isinstance(value, dict) else value for value in level]
        level = [value for table in tables for value in table if isinstance(value, dict | list)]
    if level:
        raise ValueError("nested too deeply")
    return document


def put_field(fields: dict[str, Any], name: str, value: Any, config: Path | None) -> None:
    """Set a dotted name in nested dictionaries."""
    *parents, leaf = name.split(".")
    for parent in parents:
        below = fields.setdefault(parent, {})
        if not isinstance(below, dict):
            raise InputError(config or "", parent, "is a value, not a section", f"Write [{parent}]")
        fields = below
    fields[leaf] = value
