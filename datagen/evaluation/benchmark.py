"""The frozen benchmark: its definition, and the comparison of runs with it.

The package ships `benchmark.json` in this folder; a `benchmark.json` in the folder of the runs defines
another one. `scripts/freeze_benchmark.py` writes the digests of complete runs into a definition. A run is the
folder of its name, or one file of a pack: its first scenes, with what methods may use and what scoring
reads, so that no houses, objects and runs are needed. `PACK` is the folder of the package's own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_serializer

from datagen.evaluation.methods import EvaluatedMethod
from datagen.evaluation.runs import EvaluatedRun, draws_of
from datagen.schemas.errors import InputError, choices
from datagen.schemas.identity import digest_of
from datagen.schemas.record_files import different_fields
from datagen.schemas.run_records import Digest, StoredRecord
from datagen.schemas.safe_files import read_regular
from datagen.schemas.sealing import ZIPPED
from datagen.schemas.specification import Specification
from datagen.schemas.storage import open_storage
from datagen.train.reader import Columns, read_shards
from datagen.train.run_parts import JOIN_FIELDS, open_parts, specs_of

DEFINITION = "benchmark.json"
SHIPPED = Path(str(files("datagen.evaluation") / DEFINITION))
PACK = SHIPPED.with_name("pack")
_MOST_BYTES = 2**20
_MOST_SHOWN = 5
# A run's name is that of its folder.
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,39}$")]


class RunDigests(StoredRecord):
    """sha256 over the ids of all candidates in stored order, and over their labels, or successes of draws."""

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
    """A version and the runs by name, in the order of the report."""

    version: Annotated[str, Field(min_length=1, max_length=40)]
    runs: dict[Name, BenchmarkRun] = Field(min_length=1)

    def digest(self) -> str:
        """sha256 of the version and of what defines each run."""
        runs = {
            name: {"spec": run.spec.hash(), **run.model_dump(mode="json", exclude={"spec"})}
            for name, run in self.runs.items()
        }
        return digest_of({"version": self.version, "runs": runs})

    def chosen(self, names: Sequence[str]) -> dict[str, BenchmarkRun]:
        """The runs of these names, or all, in the definition's order. InputError for an unknown name."""
        for name in names:
            if name not in self.runs:
                problem = f"is no run of benchmark {self.version}"
                raise InputError("--run", name, problem, choices(self.runs, name))
        return {name: run for name, run in self.runs.items() if not names or name in names}

    def record(self, scored: Mapping[str, BenchmarkRun]) -> dict[str, Any]:
        """Its entry in the report of the runs that were scored."""
        return {
            "version": self.version,
            "digest": self.digest(),
            "runs": {
                name: {
                    "about": run.about,
                    "spec_hash": run.spec.hash(),
                    "digests": None if run.digests is None else run.digests.model_dump(),
                }
                for name, run in scored.items()
            },
            "not_scored": [name for name in self.runs if name not in scored],
        }


def read_benchmark(folder: Path | None = None) -> Benchmark:
    """The definition in a folder of runs, else the shipped one. InputError names the first wrong field."""
    own = None if folder is None else folder / DEFINITION
    file = own if own is not None and own.exists() else SHIPPED
    data = read_regular(file, _MOST_BYTES, "Install the package again")
    try:
        return Benchmark.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        fix = "Restore the file, or write it again: scripts/freeze_benchmark.py"
        raise InputError(file, where, first["msg"], fix) from None


def shipped_pack() -> Path:
    """The folder of the package's own pack. InputError where it has none."""
    if not (PACK / DEFINITION).exists():
        fix = "Name runs of `datagen benchmark make`, or a pack"
        raise InputError("--runs", "", "is not given, and this version comes without a pack", fix)
    return PACK


def present_runs(folder: str, benchmark: Benchmark) -> dict[str, str]:
    """Paths, by name, of the benchmark's runs that a folder or address has. InputError for none."""
    found: dict[str, str] = {}
    for name in benchmark.runs:
        if _has(folder, f"{name}{ZIPPED}"):
            found[name] = f"{folder}/{name}{ZIPPED}"
        elif _has(f"{folder}/{name}", "manifest.json"):
            found[name] = f"{folder}/{name}"
    if not found:
        fix = "Make them with `datagen benchmark make`"
        raise InputError(folder, "--runs", f"has no run of benchmark {benchmark.version}", fix)
    return found


def _has(folder: str, file: str) -> bool:
    if "://" not in folder and not Path(folder).is_dir():
        return False
    return open_storage(folder, probe=False, create=False).exists(file)


def digests_of(path: str | Path) -> RunDigests:
    """The digests of a complete run or of its sealed store; copies have the same digests."""
    truth = truth_field(str(path), specs_of(path))
    return digests_over(read_shards(open_parts([path], (*JOIN_FIELDS, "sample_id", truth))), truth)


def truth_field(place: str, specs: Sequence[Specification]) -> Literal["successes", "label"]:
    """The field of a run by which methods are judged."""
    return "successes" if draws_of(place, specs) else "label"


def digests_over(shards: Iterable[Columns], truth: Literal["successes", "label"]) -> RunDigests:
    """The digests of a run with these columns."""
    candidates, labels = hashlib.sha256(), hashlib.sha256()
    for columns in shards:
        candidates.update(columns["sample_id"].tobytes())
        labels.update(columns[truth].astype("u1").tobytes())
    return RunDigests(candidates=candidates.hexdigest(), labels=labels.hexdigest())


def refuse_differing(path: str, name: str, wanted: BenchmarkRun, version: str) -> None:
    """Raise InputError with the differences from the benchmark's run.

    Digests are compared if the definition has them.
    """
    definition = f"run {name} of benchmark {version}"
    fix = f"Make it with `datagen benchmark make --run {name}`, or copy the run"
    parts = open_parts([path], (*JOIN_FIELDS, "sample_id"))
    for part in parts:
        ours, theirs = (s.model_dump(mode="json") for s in (wanted.spec, part.specs[0]))
        if rows := different_fields(ours, theirs):
            shown = [f"{field} is {b!r}, but {a!r} in {definition}" for field, a, b in rows[:_MOST_SHOWN]]
            more = f"; and {len(rows) - _MOST_SHOWN} more" if len(rows) > _MOST_SHOWN else ""
            raise InputError(path, "specification", "; ".join(shown) + more, fix)
    samples = sum(shard.samples for part in parts for shard in part.shards)
    if samples != wanted.n:
        raise InputError(path, "labels", f"are {samples:,}, but {wanted.n:,} in {definition}", fix)
    if wanted.digests is None:
        return
    found = digests_of(path)
    for column in ("candidates", "labels"):
        ours, theirs = getattr(found, column), getattr(wanted.digests, column)
        if ours != theirs:
            problem = f"have the digest {ours[:12]}, but {theirs[:12]} in {definition}"
            raise InputError(path, column, problem, fix)


def refuse_trained_objects(run: EvaluatedRun, methods: Sequence[EvaluatedMethod]) -> None:
    """Raise InputError for a model that was trained on an object of a run whose objects are held out."""
    here = run.stream.object_digests()
    for method in methods:
        if shared := here & method.objects:
            problem = (
                f"{method.name} was trained on {len(shared)} of the {len(here)} objects that it holds out"
            )
            fix = "Train on OUT/objects/train of `benchmark make`"
            raise InputError(run.place, "object_digest", problem, fix)
