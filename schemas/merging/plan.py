"""What a union of runs of one specification holds: which source gives each shard, and which are spare.

Nothing is written here, and no data is read but to compare shards that two sources hold with other bytes.
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

# What may differ between runs that merge: they are other samples of the same kind.
FREE_FIELDS = ("seed", "split", "houses", "objects", "scenes_from")
_SHOWN = 5


def refuse_incompatible(runs: Sequence[Run]) -> None:
    """Raise InputError where two runs are not of one kind, naming what differs, both values and both runs."""
    first = runs[0]
    for run in runs[1:]:
        rows = different_fields(_kind(first), _kind(run))
        if rows:
            told = "; ".join(
                f"{path}: {ours!r:.80} and {theirs!r:.80}" for path, ours, theirs in rows[:_SHOWN]
            )
            more = f"; and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
            raise InputError(
                f"{first.storage.url} and {run.storage.url}",
                rows[0][0],
                f"not of one kind ({told}{more})",
                f"Merge runs that differ in {', '.join(FREE_FIELDS[:-1])} or {FREE_FIELDS[-1]} alone",
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
    """A committed shard of a source, or a piece of it, that can be a shard of the union."""

    source: int  # place in the union's runs
    of: int  # shard in the source
    attempt: str  # its name there
    name: str  # its name in the union
    shard: int  # shard in the union
    files_digest: str  # of the source shard's list of files
    record_digest: str  # of the source shard's commit


@dataclass(frozen=True, eq=False)
class Union:
    """Runs of one specification as one.

    `out` is the place in `runs` of the run that stands where the union goes, None where none does yet.
    `kept` has the holding of every shard that some source has; `spare` the others, which hold equal rows.
    `attempts` are the attempts in each source's ledger, listed before its commits were.
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
        """How the union is cut into shards."""
        return self.manifest.layout

    def cut(self, source: int) -> Cut:
        """How a source's shards fall into the union's."""
        return Cut(self.runs[source].layout.scenes_per_shard, self.layout.scenes_per_shard)

    def commit_of(self, holding: Holding) -> Commit:
        """The source's commit of a holding, as the source has it."""
        return self.runs[holding.source].commit_of(holding.of)

    def cost_of(self, holding: Holding, commit: Commit) -> Cost:
        """A holding's cost, where its source's commit is this one."""
        return self.cut(holding.source).cost(commit.cost, holding.shard)


def plan_union(
    runs: Sequence[Run], out: int | None, layout: Layout, tick: Callable[[], None] = lambda: None
) -> Union:
    """What runs of one specification hold together, cut by `layout`, which divides theirs.

    What is committed now counts; a source may grow meanwhile. `tick` is called for every commit that was
    read. InputError when two sources hold other rows of one scene: it names both and the first difference.
    """
    attempts: list[frozenset[str]] = []
    held: dict[int, list[Holding]] = {}
    for source, run in enumerate(runs):
        # Before the commits: whatever the ledger calls committed then has its commit.
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
    """What is committed at the place of the union stays; else names decide, so that order does not."""
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
    """One of the sources' manifests, the same whatever their order, with the union's layout."""
    return min((run.manifest.model_copy(update={"layout": layout}) for run in runs), key=encode_record)


def _plan(runs: Sequence[Run]) -> Plan:
    plans = [plan for run in runs if (plan := run.plan()) is not None]
    if not plans:
        problem = "no plan says how many samples are wanted"
        raise InputError(runs[0].storage.url, "plans", problem, "Say it with `datagen extend`")
    return min(plans, key=lambda plan: (-plan.n, plan.created))
