"""Registries of label sources, houses, objects and robots, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

from datagen.workers.houses import HOUSE_SOURCES, open_houses
from datagen.workers.labels import LABEL_SOURCES, load_label_source
from datagen.workers.objects import OBJECT_SOURCES, open_objects
from datagen.workers.registry import allow
from datagen.workers.robots import ROBOTS, robot_limits

T = TypeVar("T")


class Registry(Generic[T]):
    """Names, each with an object that is loaded on access.

    `list(registry)` gives the names, and `registry[name]` loads one. An unknown name raises InputError with
    the valid ones. A name may also be `module:attribute` outside the package; a robot's, its file ROBOT.toml.

    Examples:
        >>> list(datagen.robots)
        ['fetch', 'panda', 'panda-scaled', 'pr2', 'stretch3', 'tiago-pro', 'ur5', 'xarm7']
        >>> datagen.robots["fetch"].reach_m
        (1.258, 1.258)
        >>> datagen.houses["builtin:3"].house_ids()
        ['builtin-0000', 'builtin-0001', 'builtin-0002']
    """

    def __init__(self, entries: Mapping[str, str], load: Callable[[str], T]) -> None:
        self._entries, self._load = entries, load

    def __getitem__(self, name: str) -> T:
        allow([name])
        return self._load(name)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._entries))

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __repr__(self) -> str:
        return f"Registry({', '.join(self)})"

    def _ipython_key_completions_(self) -> list[str]:
        return list(self)


# How candidates are labelled.
label_sources = Registry(LABEL_SOURCES, load_label_source)
# Sources of houses: `houses["builtin"]`, `houses["procthor:DIR"]`.
houses = Registry(HOUSE_SOURCES, open_houses)
# Sources of objects: `objects["builtin"]`, `objects["folder:DIR"]`, `objects["ycb:DIR"]`.
objects = Registry(OBJECT_SOURCES, open_objects)
# Reach, mount height and base radius of each robot.
robots = Registry(ROBOTS, robot_limits)
