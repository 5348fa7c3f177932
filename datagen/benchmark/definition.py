"""The definition of a benchmark: a version, and the specification and digests of each of its runs.

The package ships `benchmark.json` in this folder. `scripts/freeze_benchmark.py` writes the digests of
complete runs into it.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_serializer

from datagen.schemas.errors import InputError, choices
from datagen.schemas.identity import digest_of
from datagen.schemas.run_records import Digest, StoredRecord
from datagen.schemas.specification import Specification
from datagen.schemas.untrusted_files import read_regular

SHIPPED = Path(str(files("datagen.benchmark") / "benchmark.json"))
_MOST_BYTES = 2**20
# A run's name is that of its folder.
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,39}$")]


class RunDigests(StoredRecord):
    """sha256 over the ids of all candidates in stored order, and over their labels."""

    candidates: Digest
    labels: Digest


class BenchmarkRun(StoredRecord):
    """One run: its description, objects, size, specification and frozen digests.

    `objects` is a part of the objects as `datagen assets split` divides them, or all of them. `digests` is
    None until the run is made and frozen.
    """

    about: Annotated[str, Field(min_length=1, max_length=200)]
    objects: Literal["train", "test", "all"]
    n: int = Field(ge=1, le=10**9)
    spec: Specification
    digests: RunDigests | None = None

    @field_serializer("spec")
    def _as_stored(self, spec: Specification) -> dict[str, Any]:
        return spec.document()

    @property
    def is_of_grids(self) -> bool:
        """Whether each scene has the whole grid of one robot; else candidates within reach are sampled."""
        candidates = self.spec.candidates
        return candidates.per_scene == "grid" and candidates.robots_per_scene == 1


class Benchmark(StoredRecord):
    """A version and the runs by name, in the order of the leaderboard."""

    version: Annotated[str, Field(min_length=1, max_length=40)]
    runs: dict[Name, BenchmarkRun] = Field(min_length=1)

    def digest(self) -> str:
        """sha256 of the whole definition."""
        return digest_of(self.model_dump(mode="json"))

    def chosen(self, names: Sequence[str]) -> dict[str, BenchmarkRun]:
        """The runs of these names, or all, in the definition's order. InputError for an unknown name."""
        for name in names:
            if name not in self.runs:
                problem = f"is no run of benchmark {self.version}"
                raise InputError("--run", name, problem, choices(self.runs, name))
        return {name: run for name, run in self.runs.items() if not names or name in names}


def read_benchmark(path: Path | None = None) -> Benchmark:
    """The definition in a file, by default the shipped one. InputError names the first wrong field."""
    file = path or SHIPPED
    data = read_regular(file, _MOST_BYTES, "Omit --benchmark for the one that the package ships")
    try:
        return Benchmark.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        fix = "Restore the file, or write it again: scripts/freeze_benchmark.py"
        raise InputError(file, where, first["msg"], fix) from None
