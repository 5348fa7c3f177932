"""Plan the union of runs of one specification: the source of each shard, and the duplicates.

No file is written, and data is read only to compare shards that two sources have with different bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.merging.conflicts import refuse_different_rows
from datagen.schemas.merging.resharding import Cut, rank
from datagen.schemas.record_files import different_fields, encode_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, Cost, Layout, Manifest, Plan

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
    files_digest: str  # of the source shard's list of files
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
