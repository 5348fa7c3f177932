"""`--scenes-from`: the scenes and candidates of an existing run, to be labelled again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.configuration.arms import ARM_PACKAGES, complete_arm, refuse_unsuited, robot_of
from datagen.configuration.specify import (
    label_engines,
    layout_of,
    put_field,
    read_fields,
    scene_engine_names,
    validated,
)
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.scene_rows import committed_scenes
from datagen.schemas.specification import Specification

# What a configuration may still decide: how stored scenes are labelled.
_LABEL_SECTIONS = ("arm", "heuristic", "visibility")


@dataclass(frozen=True, eq=False)
class StoredScenes:
    """A run whose scenes are labelled again."""

    run: Run
    houses: str  # source references
    objects: str

    @property
    def candidates_per_scene(self) -> int:
        return self.run.layout.candidates_per_scene

    def available(self) -> int:
        """Candidates of the scenes that are committed without a gap."""
        return committed_scenes(self.run) * self.candidates_per_scene


def open_stored_scenes(
    place: str, houses: str | None, objects: str | None, given: Mapping[str, Any]
) -> StoredScenes:
    """The run at `place`. `given` are the options that decide scenes, by name: none may be given.

    `houses` and `objects` are where the sources lie now, None where the run found them. Raises
    InputError for an option that would change scenes or candidates, and for a place without a run.
    """
    for option, value in given.items():
        if value is not None and value is not False:
            problem = "scenes and candidates are those of --scenes-from"
            raise InputError(option, str(value), problem, f"Take {option} out, or --scenes-from")
    run = Run.open(place)
    _ = run.schema  # refuses stores of another version, whose rows would not fit
    sources = run.manifest.sources
    return StoredScenes(
        run, houses or sources.get("houses", "builtin"), objects or sources.get("objects", "builtin")
    )


def specify_again(
    label_source: str,
    stored: StoredScenes,
    config: Path | None,
    robot: str | None = None,
    repeats: int | None = None,
    options: Mapping[str, Any] | None = None,
) -> Specification:
    """The stored run's specification with other labels.

    The configuration may set the sections `arm`, `heuristic` and `visibility`; what it leaves out is as
    in the stored run. `options`, by dotted name, win over it. Raises InputError for other sections, and
    for a robot that the stored candidates do not suit.
    """
    before = stored.run.manifest.spec
    place = str(config) if config else "options"
    chosen = read_fields(config)
    for section in chosen:
        if section not in _LABEL_SECTIONS:
            problem = "decides scenes and candidates, which are those of --scenes-from"
            raise InputError(place, section, problem, "Take it out")
    for name, value in (options or {}).items():
        put_field(chosen, name, value, config)
    fields = before.model_dump(mode="json", exclude_none=True)
    arm = fields.pop("arm", {})
    # Which arm it is and how it plans stays; whether worlds are disturbed is said for each run.
    arm.pop("disturbance", None)
    if label_source != before.label_source:
        arm.pop("trial", None)
    defaults = {"arm": arm} if arm and label_source in ARM_PACKAGES else {}
    fields = _merged(fields | defaults, chosen)
    complete_arm(label_source, fields, robot, repeats, place)
    suited = robot_of(fields, robot)
    engines = {name: v for name, v in before.engines.items() if name in scene_engine_names(before)}
    fields |= {
        "label_source": label_source,
        "scenes_from": {"spec_hash": before.scenes_hash},
        "engines": engines | label_engines(label_source),
    }
    spec = validated(fields, place)
    if suited is not None:
        mend = f"Make the scenes with `datagen submit heuristic --robot {suited}`, or take another robot"
        refuse_unsuited(spec, suited, stored.run.storage.url, mend)
    return spec


def layout_again(spec: Specification, stored: StoredScenes, n: int) -> Layout:
    """The layout of a new run of n labels whose whole shards are within the stored scenes."""
    per_scene, there = stored.candidates_per_scene, stored.available() // stored.candidates_per_scene
    wanted = -(-n // per_scene)
    most = layout_of(spec, n).scenes_per_shard
    fitting = next((k for k in range(most, 0, -1) if -(-wanted // k) * k <= there), 1)
    return Layout(scenes_per_shard=fitting, candidates_per_scene=per_scene)


def refuse_too_few(stored: StoredScenes, layout: Layout, n: int) -> None:
    """Raise InputError where n labels in shards of this layout need more scenes than are stored."""
    shards = stored.available() // layout.samples_per_shard
    if layout.shards_for(n) > shards:
        raise InputError(
            "--n",
            str(n),
            f"{stored.run.storage.url} has {shards * layout.samples_per_shard} committed candidates for it",
            "Ask for fewer labels, or extend that run first",
        )


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionaries, `above` over `below`."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = _merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
