"""`--scenes-from`: label the scenes and candidates of an existing run again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from datagen.configuration.robot_fields import complete_arm, refuse_unsuited, robot_of
from datagen.configuration.specify import layout_of, put_field, read_fields, validated
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.specification import Specification
from datagen.workers.engine_versions import ARM_PACKAGES, label_engines, scene_engine_names
from datagen.workers.robots import remember

# Sections that a configuration may set for stored scenes.
_LABEL_SECTIONS = ("arm", "heuristic", "visibility")


@dataclass(frozen=True, eq=False)
class StoredScenes:
    """A run whose scenes are labelled again."""

    run: Run
    houses: str  # source references
    objects: str
    robot: str = ""  # place of the robot's file; "" for one of the registry

    def available(self) -> int:
        """Number of candidates in the scenes before the first missing shard."""
        committed = self.run.committed()
        return next(k for k in count() if k not in committed) * self.run.layout.samples_per_shard


def open_stored_scenes(
    path: str, houses: str | None, objects: str | None, given: Mapping[str, Any]
) -> StoredScenes:
    """Open the run at `path`. `given` are the options that decide scenes, by name: all must be unset.

    `houses` and `objects` are the present sources, None for those in the run's manifest. Raises InputError
    for an option that would change scenes or candidates, and for a path without a run.
    """
    for option, value in given.items():
        if value is not None and value is not False:
            problem = "cannot change the scenes and candidates of --scenes-from"
            raise InputError(option, str(value), problem, f"Omit {option} or --scenes-from")
    run = Run.open(path)
    _ = run.schema  # InputError for stores of another version, whose rows do not fit
    sources = run.manifest.sources
    arm, robot = run.manifest.spec.arm, sources.get("robot", "")
    if arm is not None and arm.robot_digest is not None:
        remember(robot or arm.robot, arm.robot, arm.robot_digest)
    here = houses or sources.get("houses", "builtin"), objects or sources.get("objects", "builtin")
    return StoredScenes(run, *here, robot)


def specify_again(
    label_source: str,
    stored: StoredScenes,
    config: Path | None,
    robot: str | None = None,
    repeats: int | None = None,
    draws: int | None = None,
    options: Mapping[str, Any] | None = None,
) -> Specification:
    """Return the stored run's specification with another label source or other parameters of labels.

    The configuration may set the sections `arm`, `heuristic` and `visibility`; the rest is as in the stored
    run. `options`, by dotted name, override it. Raises InputError for other sections, and for a robot that
    the stored candidates do not suit.
    """
    before = stored.run.manifest.spec
    place = str(config) if config else "options"
    chosen = read_fields(config)
    for section in chosen:
        if section not in _LABEL_SECTIONS:
            problem = "cannot change the scenes and candidates of --scenes-from"
            raise InputError(place, section, problem, "Remove the section")
    for name, value in (options or {}).items():
        put_field(chosen, name, value, config)
    fields = before.model_dump(mode="json", exclude_none=True)
    arm = fields.pop("arm", {})
    # The robot and its planning stay; disturbances and draws are chosen for each run.
    arm.pop("disturbance", None)
    arm.pop("draws", None)
    if label_source != before.label_source:
        arm.pop("trial", None)
    defaults = {"arm": arm} if arm and label_source in ARM_PACKAGES else {}
    fields = _merged(fields | defaults, chosen)
    complete_arm(label_source, fields, robot, repeats, place, draws)
    suited = robot_of(fields, robot)
    engines = {name: v for name, v in before.engines.items() if name in scene_engine_names(before)}
    fields |= {
        "label_source": label_source,
        "scenes_from": {"spec_hash": before.scenes_hash},
        "engines": engines | label_engines(label_source),
    }
    spec = validated(fields, place)
    if suited is not None:
        fix = f"Make the scenes with `datagen submit heuristic --robot {suited}`, or choose another robot"
        refuse_unsuited(spec, suited, stored.run.storage.url, fix)
    return spec


def specify_view(
    label_source: str, stored: StoredScenes, given: Mapping[str, Any], view: int
) -> Specification:
    """Return the stored run's specification with clouds from its `view`-th other viewpoint.

    Labels stay as they are. Raises InputError for another label source, and for options `given` by name that
    would change labels.
    """
    before = stored.run.manifest.spec
    fix = "Omit it: scenes seen from another viewpoint keep their labels"
    if label_source != before.label_source:
        problem = f"is not that of {stored.run.storage.url} ({before.label_source})"
        raise InputError("--view", label_source, problem, f"Submit {before.label_source}")
    for option, value in given.items():
        if value is not None:
            raise InputError(option, str(value), "is given with --view", fix)
    fields = before.model_dump(mode="json", exclude_none=True)
    return validated(fields | {"scenes_from": {"spec_hash": before.scenes_hash, "view": view}}, "--view")


def layout_again(spec: Specification, stored: StoredScenes, n: int) -> Layout:
    """The layout of a new run of n labels, in shards that the stored scenes fill."""
    per_scene = stored.run.layout.candidates_per_scene
    available = stored.available() // per_scene
    wanted = -(-n // per_scene)
    most = layout_of(spec, n).scenes_per_shard
    fitting = next((k for k in range(most, 0, -1) if -(-wanted // k) * k <= available), 1)
    return Layout(scenes_per_shard=fitting, candidates_per_scene=per_scene)


def refuse_too_few(stored: StoredScenes, layout: Layout, n: int) -> None:
    """Raise InputError where n labels in shards of this layout need more scenes than there are."""
    shards = stored.available() // layout.samples_per_shard
    if (needed := layout.shards_for(n)) > shards:
        wanted = needed * layout.samples_per_shard
        grown = f" --n {wanted}" if wanted > stored.run.n else ""
        raise InputError(
            "--n",
            str(n),
            f"is more than the {shards * layout.samples_per_shard:,} candidates of {stored.run.storage.url}",
            f"Ask for fewer labels, or extend that run first: {stored.run.command_for_missing}{grown}",
        )


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionaries merged; `above` overrides `below`."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = _merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
