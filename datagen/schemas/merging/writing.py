"""Write a planned union: shards first, then the ledger, quarantine and lineage.

Every step skips existing files, so that a killed merge is completed by running it again.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, replace
from itertools import groupby

from datagen.schemas.errors import InputError
from datagen.schemas.lineage import LINEAGE, Origins, ShardOrigin, encode_lineage
from datagen.schemas.merging.plan import Holding, Union
from datagen.schemas.outcomes import REDRAW_CAUSES
from datagen.schemas.record_files import (
    LOST_CAUSE,
    MAX_RECORD_BYTES,
    copy_key,
    encode_record,
    end_from_commit,
    end_key,
    lost_end,
    publish,
    shard_folder,
    start_key,
)
from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart, Commit, LedgerEntry, QuarantineRecord
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.shard_reading import read_shard
from datagen.schemas.storage import Storage

Tick = Callable[[], None]


@dataclass(frozen=True, eq=False)
class WrittenUnion:
    """The result of a union. `there` counts shards that existed before."""

    run: Run
    there: int
    linked: int
    cut: int
    spare: int  # shards that several sources have
    attempts: int


def begin_union(union: Union, storage: Storage) -> Run:
    """Open the union's run with its manifest and plan, or create it.

    InputError where there is another run.
    """
    if not storage.exists("manifest.json"):
        publish(storage, "manifest.json", encode_record(union.manifest))
    run = Run.open(storage)
    for field, found, expected in (
        ("spec_hash", run.manifest.spec_hash, union.manifest.spec_hash),
        ("layout", run.layout, union.layout),
    ):
        if found != expected:
            problem = f"is {found}, but {expected} in the merged run"
            raise InputError(f"{storage.url}/manifest.json", field, problem, "Choose a new --out")
    run.grow(union.plan.n, union.plan.created)
    return run


def write_union(union: Union, run: Run, tick: Tick = lambda: None) -> WrittenUnion:
    """Write the union into its run; `tick` is called for every shard and every attempt.

    InputError where a source lacks a committed file, or a file to split is damaged.
    """
    before = run.committed()
    wanted = [union.kept[shard] for shard in sorted(union.kept)]
    new = [holding for holding in wanted if holding.shard not in before]
    lost = [h for h in wanted if h.shard in before and h.source != union.out and _is_lost(run, h)]
    linked = cut = 0
    for (source, _), group in groupby(new, key=lambda holding: (holding.source, holding.of)):
        holdings = list(group)
        is_cut = union.cut(source).pieces > 1
        won = _cut(union, run, holdings) if is_cut else [_link(union, run, holdings[0])]
        lost += [h for h, is_won in zip(holdings, won, strict=True) if not is_won]
        linked, cut = linked + (not is_cut), cut + is_cut * len(holdings)
        for _ in holdings:
            tick()
    union = _without(union, lost)
    quarantined = _quarantined_only(union)
    attempts = _write_ledger(union, run, quarantined, tick)
    for shard in sorted(quarantined.keys() - run.quarantined()):
        run.quarantine(quarantined[shard])
    replace_record(run.storage, LINEAGE, encode_lineage(_lineage(union)))
    return WrittenUnion(run, len(wanted) - len(new), linked, cut, len(union.spare), attempts)


def replace_record(storage: Storage, key: str, record: bytes) -> None:
    """Write a record that may change, its copy first; unchanged ones are not written."""
    for name in (copy_key(key), key):
        _replace(storage, name, record)


def _replace(storage: Storage, key: str, record: bytes) -> None:
    if storage.get(key, MAX_RECORD_BYTES) != record:
        storage.put(key, record)
        storage.sync([key])


def _link(union: Union, run: Run, holding: Holding) -> bool:
    """Link a source's shard; return whether it became the union's."""
    source, commit = union.runs[holding.source], union.commit_of(holding)
    source.check_files(commit)
    folder = shard_folder(holding.shard, holding.attempt)
    keys = [f"{folder}/{entry.path}" for entry in commit.files]
    largest = max((entry.size for entry in commit.files), default=0)
    run.storage.adopt_many(source.storage, zip(keys, keys, strict=True), largest)
    run.storage.sync(keys)
    return run.commit(commit)


def _cut(union: Union, run: Run, holdings: list[Holding]) -> list[bool]:
    """Write pieces of a source's shard as shards; return for each whether it became the union's."""
    source = union.runs[holdings[0].source]
    whole = union.commit_of(holdings[0])
    arrays = read_shard(source, holdings[0].of)
    schema, layout = source.schema, union.layout
    won: list[bool] = []
    for holding in holdings:
        position = holding.shard - union.cut(holding.source).first(holding.of)
        scenes = slice(position * layout.scenes_per_shard, (position + 1) * layout.scenes_per_shard)
        samples = slice(position * layout.samples_per_shard, (position + 1) * layout.samples_per_shard)
        scene_arrays = {f.name: arrays[f.name][scenes] for f in schema.scene_fields}
        sample_arrays = {f.name: arrays[f.name][samples] for f in schema.sample_fields}
        files = encode_shard(schema, layout, run.manifest.spec_hash, scene_arrays, sample_arrays)
        redraws = dict(zip(REDRAW_CAUSES, scene_arrays["redraws"].sum(axis=0).tolist(), strict=True))
        commit = Commit(
            shard=holding.shard,
            attempt=holding.name,
            spec_hash=whole.spec_hash,
            scenes=layout.scenes_per_shard,
            samples=layout.samples_per_shard,
            positives=int(sample_arrays["label"].sum()),
            redraws={cause: count for cause, count in redraws.items() if count},
            files=run.write_shard(holding.shard, holding.name, files),
            cost=union.cost_of(holding, whole),
            host=whole.host,
            created=whole.created,
        )
        won.append(run.commit(commit))
    return won


def _is_lost(run: Run, holding: Holding) -> bool:
    """Whether the output has this shard from another attempt than planned."""
    return run.commit_of(holding.shard).attempt != holding.name


def _without(union: Union, lost: Iterable[Holding]) -> Union:
    kept, spare = dict(union.kept), dict(union.spare)
    for holding in lost:
        spare[holding.shard] = (*spare.get(holding.shard, ()), kept.pop(holding.shard))
    return replace(union, kept=kept, spare=spare)


def _write_ledger(union: Union, run: Run, quarantined: Container[int], tick: Tick) -> int:
    there = {file.key for file in run.storage.list("ledger")}
    ledger = UnitedLedger(union, quarantined)

    def write(name: str) -> None:
        for key, record in zip((start_key(name), end_key(name)), ledger.records(name), strict=True):
            if record is not None and key in there:
                _replace(run.storage, key, encode_record(record))  # it may have less information
            elif record is not None:
                run.storage.put_new(key, encode_record(record))

    storages = [run.storage, *(source.storage for source in union.runs)]
    # Several at once where any of them is remote.
    storage = next((one for one in storages if one.folder is None), run.storage)
    for _ in storage.concurrent_map(write, ledger.names):
        tick()
    return len(ledger.names)


def _quarantined_only(union: Union) -> dict[int, QuarantineRecord]:
    """Records of the shards that are quarantined in a source and committed in none, by shard."""
    found: dict[int, QuarantineRecord] = {}
    scenes = union.layout.scenes_per_shard
    for source, run in enumerate(union.runs):
        for record in run.quarantine_records():
            for shard in union.cut(source).shards(record.shard):
                changed = {"shard": shard, "first_scene": shard * scenes, "scenes": scenes}
                piece = record.model_copy(update=changed)
                found[shard] = min(found.get(shard, piece), piece, key=encode_record)
    return {shard: record for shard, record in found.items() if shard not in union.kept}


def _lineage(union: Union) -> dict[ShardOrigin, list[int]]:
    """The shards of each origin; where several sources have a shard from one attempt, the first counts."""
    origins = [Origins(run) for run in union.runs]
    shards: dict[ShardOrigin, list[int]] = {}
    for source, known in enumerate(origins):
        if known.is_merged:
            shards |= {origin: [] for origin in known.named}
        elif source != union.out:
            shards[known.own] = []
    own = None if union.out is None else origins[union.out].own
    for shard, holding in union.kept.items():
        same = [h for h in (holding, *union.spare.get(shard, ())) if h.name == holding.name]
        claims = {origins[h.source].of(h.of) for h in same}
        # A killed merge may not have written the origins of its shards.
        others = claims - {own} if len(claims) > 1 else claims
        shards.setdefault(min(others), []).append(shard)
    return shards


SPARE_CAUSE = "merged: this shard is kept from another attempt"
GUESS_CAUSE = f"merged: {LOST_CAUSE}"  # of a guess made here, which a recorded one replaces


@dataclass(frozen=True)
class _NamedAttempt:
    """An attempt in a source: its name there, and the piece of it."""

    source: int
    attempt: str
    piece: int | None  # shard of the union; None for the whole attempt


class UnitedLedger:
    """The ledger of a union, whose attempts have `names`.

    An attempt without an end is lost, with unknown cost, where its shard is kept or in `quarantined`.
    """

    def __init__(self, union: Union, quarantined: Container[int]) -> None:
        self._union, self._quarantined = union, quarantined
        self._kept = {holding.name: holding for holding in union.kept.values()}
        self._spare = {holding.name: holding for holdings in union.spare.values() for holding in holdings}
        self._named = _named_attempts(union)
        self.names = sorted(self._named)

    def records(self, name: str) -> tuple[AttemptStart | None, LedgerEntry | None]:
        """Read the start and the end of an attempt; None for one that is missing in every source."""
        union = self._union
        starts: list[AttemptStart] = []
        ends: list[LedgerEntry] = []
        for named in self._named[name]:
            ledger, cut = union.runs[named.source].ledger, union.cut(named.source)
            start, end = ledger.start_of(named.attempt), ledger.end_of(named.attempt)
            if start is not None:
                shard = cut.first(start.shard) if named.piece is None else named.piece
                starts.append(start.model_copy(update={"attempt": name, "shard": shard}))
            if end is not None:
                shard = cut.first(end.shard) if named.piece is None else named.piece
                cost = (
                    end.cost if named.piece is None or end.cost is None else cut.cost(end.cost, named.piece)
                )
                ends.append(end.model_copy(update={"attempt": name, "shard": shard, "cost": cost}))
        start = min(starts, key=encode_record) if starts else None
        held = self._kept.get(name) or self._spare.get(name)
        if held is not None:
            return start, _end_of_held(union, held, start, ends, name in self._kept)
        if start is not None and not ends and (start.shard in union.kept or start.shard in self._quarantined):
            ends.append(lost_end(start, cause=GUESS_CAUSE))
        return start, min(ends, key=_account_first) if ends else None


def _named_attempts(union: Union) -> dict[str, list[_NamedAttempt]]:
    found: dict[str, list[_NamedAttempt]] = {}
    of_source: list[dict[str, int]] = [{} for _ in union.runs]
    for holdings in (union.kept.values(), *union.spare.values()):
        for holding in holdings:
            of_source[holding.source][holding.attempt] = holding.of
    for source, run in enumerate(union.runs):
        cut, committed = union.cut(source), of_source[source]
        for attempt in union.attempts[source] | committed.keys():
            shard = committed.get(attempt)
            if cut.pieces > 1 and shard is None:
                end = run.ledger.end_of(attempt)
                shard = end.shard if end is not None and end.outcome == "superseded" else None
            pieces = cut.shards(shard) if cut.pieces > 1 and shard is not None else (None,)
            for piece in pieces:
                name = attempt if piece is None else cut.name(attempt, piece)
                found.setdefault(name, []).append(_NamedAttempt(source, attempt, piece))
    return found


def _end_of_held(
    union: Union, holding: Holding, start: AttemptStart | None, ends: list[LedgerEntry], is_kept: bool
) -> LedgerEntry:
    """The end record of an attempt that made a shard, with its commit's cost, also without a ledger entry."""
    commit = union.commit_of(holding)
    truth = {
        "outcome": "committed" if is_kept else "superseded",
        "cause": "" if is_kept else SPARE_CAUSE,
        "stack": "",
        "cost": union.cost_of(holding, commit),
    }
    # Records derived from the commit come last: merging again must prefer recorded ones.
    named = {"attempt": holding.name, "shard": holding.shard}
    derived = end_from_commit(commit, start.started if start else "").model_copy(update={**named, **truth})
    noted = [end.model_copy(update={**truth, "host": end.host or commit.host}) for end in ends]
    return min([*noted, derived], key=lambda end: (end == derived, encode_record(end)))


def _account_first(end: LedgerEntry) -> tuple[bool, bool, bytes]:
    """Sort key of several ends of one attempt: with cost before without, then guesses last."""
    return end.cost is None, end.cause == GUESS_CAUSE, encode_record(end)
