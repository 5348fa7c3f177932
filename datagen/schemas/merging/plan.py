"""Plan the union of runs of one specification: the source of each shard, and the duplicates.

No file is written, and data is read only to compare shards that two sources have with different bytes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.merging.conflicts import refuse_different_rows
from datagen.schemas.record_files import different_fields, encode_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, Cost, Layout, Manifest, Plan

_PIECE = re.compile(r"(.*)\.cut([0-9]+)")
_MAX_NAME = 100
_NS = 10**9


def common_layout(layouts: Iterable[Layout]) -> Layout:
    """The layout of the largest shards that divide those of every layout, for equal candidates per scene."""
    found = list(layouts)
    scenes = math.gcd(*(layout.scenes_per_shard for layout in found))
    return Layout(scenes_per_shard=scenes, candidates_per_scene=found[0].candidates_per_scene)


@dataclass(frozen=True)
class Cut:
    """Split of shards of `scenes` scenes into shards of `into` scenes, a divisor."""

    scenes: int
    into: int

    @property
    def pieces(self) -> int:
        """Pieces per shard; 1 without a split."""
        return self.scenes // self.into

    def first(self, shard: int) -> int:
        """The first piece of a shard, as a shard of the smaller layout."""
        return shard * self.pieces

    def shards(self, shard: int) -> range:
        """The pieces of a shard, as shards of the smaller layout."""
        return range(self.first(shard), self.first(shard + 1))

    def name(self, attempt: str, piece: int) -> str:
        """Name of the attempt of this piece, with the piece's first scene."""
        return attempt if self.pieces == 1 else f"{_fitting(base_name(attempt))}.cut{piece * self.into}"

    def cost(self, cost: Cost, piece: int) -> Cost:
        """The cost of a piece: equal shares per scene, to the nanosecond and byte; pieces sum to the whole.

        Remainders of nanoseconds and bytes go to the first scenes. Peak memory is that of the attempt.
        """
        if self.pieces == 1:
            return cost
        offset = piece % self.pieces * self.into

        def seconds(value: float) -> float:
            return _share(round(value * _NS), self.scenes, offset, self.into) / _NS

        by_name = {
            field: {name: seconds(value) for name, value in getattr(cost, field).items()}
            for field in ("stage_wall_s", "stage_cpu_s", "stage_gpu_s", "source_s")
        }
        written = _share(cost.written_bytes, self.scenes, offset, self.into)
        whole = {"wall_s": seconds(cost.wall_s), "cpu_s": seconds(cost.cpu_s), "written_bytes": written}
        return cost.model_copy(update=whole | by_name)


def base_name(attempt: str) -> str:
    """Name of the attempt that a piece comes from; its own where it is not split."""
    found = _PIECE.fullmatch(attempt)
    return found[1] if found else attempt


def rank(attempt: str) -> tuple[str, str]:
    """Sort key of equal attempts: the names of the unsplit attempts; the first is kept."""
    return _fitting(base_name(attempt)), attempt


def _share(total: int, scenes: int, first: int, count: int) -> int:
    """The share of `count` scenes from `first` on in a total over all scenes."""
    each, rest = divmod(total, scenes)
    return each * count + min(max(rest - first, 0), count)


def _fitting(name: str) -> str:
    # Names have at most 100 characters, and a piece's name is longer.
    return name if len(name) <= _MAX_NAME - 20 else sha256(name.encode()).hexdigest()[:32]


# Fields that may differ between merged runs: they give other samples of the same kind.
FREE_FIELDS = ("seed", "split", "houses", "objects", "scenes_from")
_SHOWN = 5


def refuse_incompatible(runs: Sequence[Run]) -> None:
    """Raise InputError where two runs are of different kinds, with the differing fields of both."""
    first = runs[0]
    for run in runs[1:]:
        rows = different_fields(_kind(first), _kind(run))
        if rows:
            shown = "; ".join(
                f"{path}: {ours!r:.80} and {theirs!r:.80}" for path, ours, theirs in rows[:_SHOWN]
            )
            more = f"; and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
            raise InputError(
                f"{first.storage.url} and {run.storage.url}",
                rows[0][0],
                f"differs in kind ({shown}{more})",
                f"Merge runs that differ only in {', '.join(FREE_FIELDS[:-1])} or {FREE_FIELDS[-1]}",
            )


def _kind(run: Run) -> dict[str, object]:
    manifest = run.manifest
    return {
        "schema_name": manifest.schema_name,
        "schema_version": manifest.schema_version,
        "candidates_per_scene": manifest.layout.candidates_per_scene,
        **manifest.spec.model_dump(mode="json", exclude=set(FREE_FIELDS)),
    }


@dataclass(frozen=True, slots=True)
class Holding:
    """A committed shard of a source, or a piece of it, as a shard of the union."""

    source: int  # index in the union's runs
    of: int  # shard in the source
    attempt: str  # its name there
    name: str  # its name in the union
    shard: int  # shard in the union
    files_digest: str  # sha256 over the source shard's list of files
    record_digest: str  # of the source shard's commit


@dataclass(frozen=True, eq=False)
class Union:
    """The union of runs of one specification.

    `out` is the index in `runs` of an existing run at the output, else None. `kept` has the chosen holding of
    every shard; `spare` the duplicates, which have equal rows. `attempts` are those in each source's ledger,
    listed before its commits.
    """

    runs: tuple[Run, ...]
    out: int | None
    manifest: Manifest
    plan: Plan
    kept: Mapping[int, Holding]
    spare: Mapping[int, tuple[Holding, ...]]
    attempts: tuple[frozenset[str], ...]

    @property
    def layout(self) -> Layout:
        return self.manifest.layout

    def cut(self, source: int) -> Cut:
        """How a source's shards are split into the union's."""
        return Cut(self.runs[source].layout.scenes_per_shard, self.layout.scenes_per_shard)

    def commit_of(self, holding: Holding) -> Commit:
        return self.runs[holding.source].commit_of(holding.of)

    def cost_of(self, holding: Holding, commit: Commit) -> Cost:
        return self.cut(holding.source).cost(commit.cost, holding.shard)


def plan_union(
    runs: Sequence[Run], out: int | None, layout: Layout, tick: Callable[[], None] = lambda: None
) -> Union:
    """Plan the union of runs of one specification, with `layout`, which divides theirs.

    Shards committed now count; a source may grow meanwhile. `tick` is called for every commit that was read.
    InputError when two sources have different rows for a scene: it names both and the first difference.
    """
    attempts: list[frozenset[str]] = []
    held: dict[int, list[Holding]] = {}
    for source, run in enumerate(runs):
        # Before the commits, so that every attempt that the ledger calls committed has its commit.
        attempts.append(frozenset(run.ledger.attempts()))
        cut = Cut(run.layout.scenes_per_shard, layout.scenes_per_shard)
        for holding in _holdings(run, source, cut):
            held.setdefault(holding.shard, []).append(holding)
            if holding.shard == cut.first(holding.of):
                tick()
    kept: dict[int, Holding] = {}
    spare: dict[int, tuple[Holding, ...]] = {}
    compared: set[tuple[int, int, int, int]] = set()
    for shard in sorted(held):
        best, *rest = sorted(held[shard], key=lambda h: _preference(h, out, runs, layout))
        for other in rest:
            _refuse_conflict(runs, best, other, compared)
        kept[shard] = best
        if rest:
            spare[shard] = tuple(rest)
    return Union(
        runs=tuple(runs),
        out=out,
        manifest=_manifest(runs, layout),
        plan=_plan(runs),
        kept=kept,
        spare=spare,
        attempts=tuple(attempts),
    )


def _holdings(run: Run, source: int, cut: Cut) -> Iterator[Holding]:
    for commit in run.commits():
        files = digest_of(sorted((entry.path, entry.sha256) for entry in commit.files))
        record = digest_of(commit.model_dump(mode="json"))
        for shard in cut.shards(commit.shard):
            name = cut.name(commit.attempt, shard)
            yield Holding(source, commit.shard, commit.attempt, name, shard, files, record)


def _preference(holding: Holding, out: int | None, runs: Sequence[Run], layout: Layout) -> tuple[object, ...]:
    """Sort key: shards at the output are kept; else names decide, not the order of the sources."""
    is_cut = runs[holding.source].layout != layout
    return (
        holding.source != out,
        *rank(holding.name),
        is_cut,
        holding.record_digest,
        runs[holding.source].storage.url,
    )


def _refuse_conflict(
    runs: Sequence[Run], ours: Holding, theirs: Holding, compared: set[tuple[int, int, int, int]]
) -> None:
    one, other = runs[ours.source], runs[theirs.source]
    if one.layout == other.layout and ours.files_digest == theirs.files_digest:
        return
    pair = (ours.source, ours.of, theirs.source, theirs.of)
    if pair not in compared:
        compared.add(pair)
        refuse_different_rows(one, ours.of, other, theirs.of)


def _manifest(runs: Iterable[Run], layout: Layout) -> Manifest:
    """One of the sources' manifests, independent of their order, with the union's layout."""
    return min((run.manifest.model_copy(update={"layout": layout}) for run in runs), key=encode_record)


def _plan(runs: Sequence[Run]) -> Plan:
    plans = [plan for run in runs if (plan := run.plan()) is not None]
    if not plans:
        problem = "has no plan with the number of samples wanted"
        raise InputError(runs[0].storage.url, "plans", problem, "Set it with `datagen resume RUN --n N`")
    return min(plans, key=lambda plan: (-plan.n, plan.created))
