"""Options that benchmarks over drawn scenes share."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import Source, Specification
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.scenes import Scene
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.world import assemble_world


def scene_options(about: str | None) -> argparse.ArgumentParser:
    """A parser with the sources, number and seed of drawn scenes."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    return parser


def drawn_scenes(options: argparse.Namespace) -> Iterator[tuple[int, Scene]]:
    """Index and scene of the drawn scenes of test houses."""
    opened = open_houses(options.houses), open_objects(options.objects)
    house, thing = (Source(kind=source.kind, digest=source.digest) for source in opened)
    spec = Specification(seed=options.seed, split="test", houses=house, objects=thing)
    world = assemble_world(spec, *opened, options.houses, options.objects)
    for index in range(options.scenes):
        yield index, generate_scene(world, index, StageClock())[0]
