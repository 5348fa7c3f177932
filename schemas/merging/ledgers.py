"""Merge ledgers: every attempt once, with its cost.

Where a shard is kept from another attempt, an attempt is superseded. Attempts of resharded shards are split
with them, each piece with its share of the cost; unsuccessful ones are kept whole, with their first piece.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from datagen.schemas.keys import commit_key
from datagen.schemas.ledger import LOST_CAUSE, end_from_commit, end_key, lost_end, start_key
from datagen.schemas.merging.plan import Holding, Union
from datagen.schemas.record_files import MAX_RECORD_BYTES, Record, decode_record, encode_record
from datagen.schemas.run_records import AttemptStart, Commit, LedgerEntry
from datagen.schemas.storage import Storage

SPARE_CAUSE = "merged: this shard is kept from another attempt"
GUESS_CAUSE = f"merged: {LOST_CAUSE}"  # of a guess made here, which a recorded one replaces
_AT_ONCE = 256  # attempts whose records are in memory


@dataclass(frozen=True)
class UnitedAttempt:
    """The records of one attempt in the union; `end` is None while it has not ended."""

    name: str
    start: AttemptStart | None
    end: LedgerEntry | None


@dataclass(frozen=True)
class _NamedAttempt:
    """An attempt in a source: its name there, and the piece of it."""

    source: int
    attempt: str
    piece: int | None  # shard of the union; None for the whole attempt


def united_attempts(union: Union, given_up: Container[int] = ()) -> Iterator[UnitedAttempt]:
    """Yield every attempt of the union in order of names; records are read some hundreds at a time.

    An attempt without an end is lost, with unknown cost, where its shard is kept or in `given_up`.
    """
    spare = {holding.name: holding for holdings in union.spare.values() for holding in holdings}
    kept = {holding.name: holding for holding in union.kept.values()}
    places = _places(union)
    names = iter(sorted(places))
    while some := list(islice(names, _AT_ONCE)):
        held = {name: kept.get(name) or spare.get(name) for name in some}
        records = _Records(union, [place for name in some for place in places[name]], held.values())
        for name in some:
            starts, ends = records.starts(name, places[name]), records.ends(name, places[name])
            start = min(starts, key=encode_record) if starts else None
            if (holding := held[name]) is not None:
                end = _end_of_held(union, holding, records.commit_of(holding), start, ends, name in kept)
                yield UnitedAttempt(name, start, end)
                continue
            if start is not None and not ends and (start.shard in union.kept or start.shard in given_up):
                ends.append(lost_end(start, cause=GUESS_CAUSE))
            yield UnitedAttempt(name, start, min(ends, key=_account_first) if ends else None)


def _places(union: Union) -> dict[str, list[_NamedAttempt]]:
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


class _Records:
    """Records of some attempts in the sources, and their commits."""

    def __init__(
        self, union: Union, places: Iterable[_NamedAttempt], holdings: Iterable[Holding | None]
    ) -> None:
        self._union = union
        self._starts: dict[tuple[int, str], AttemptStart] = {}
        self._ends: dict[tuple[int, str], LedgerEntry] = {}
        self._commits: dict[tuple[int, int], Commit] = {}
        named, made = sorted({(p.source, p.attempt) for p in places}), {h for h in holdings if h is not None}
        for source, run in enumerate(union.runs):
            attempts = [attempt for of, attempt in named if of == source]
            for attempt, start in _read(run.storage, attempts, start_key, AttemptStart):
                self._starts[source, attempt] = start
            for attempt, end in _read(run.storage, attempts, end_key, LedgerEntry):
                self._ends[source, attempt] = end
            shards = sorted({holding.of for holding in made if holding.source == source})
            found = run.storage.get_many(map(commit_key, shards), MAX_RECORD_BYTES)
            for shard, (_, data) in zip(shards, found, strict=True):
                if data is not None:
                    self._commits[source, shard] = run.decode_commit(shard, data)

    def commit_of(self, holding: Holding) -> Commit:
        """The source's commit of a holding. InputError where it was removed meanwhile."""
        found = self._commits.get((holding.source, holding.of))
        return self._union.commit_of(holding) if found is None else found

    def starts(self, name: str, places: Iterable[_NamedAttempt]) -> list[AttemptStart]:
        """The start record of an attempt from the sources, with the union's name and shard number."""
        found: list[AttemptStart] = []
        for place in places:
            start = self._starts.get((place.source, place.attempt))
            if start is not None:
                shard = place.piece
                if shard is None:
                    shard = self._union.cut(place.source).first(start.shard)
                found.append(start.model_copy(update={"attempt": name, "shard": shard}))
        return found

    def ends(self, name: str, places: Iterable[_NamedAttempt]) -> list[LedgerEntry]:
        """The end record of an attempt from the sources, with the union's name and shard number."""
        found: list[LedgerEntry] = []
        for place in places:
            end = self._ends.get((place.source, place.attempt))
            if end is None:
                continue
            cut, shard, cost = self._union.cut(place.source), place.piece, end.cost
            if shard is None:
                shard = cut.first(end.shard)
            elif cost is not None:
                cost = cut.cost(cost, shard)
            found.append(end.model_copy(update={"attempt": name, "shard": shard, "cost": cost}))
        return found


def _read(
    storage: Storage, attempts: Sequence[str], key_of: Callable[[str], str], model: type[Record]
) -> Iterator[tuple[str, Record]]:
    found = storage.get_many(map(key_of, attempts), MAX_RECORD_BYTES)
    for attempt, (key, data) in zip(attempts, found, strict=True):
        if data is not None:
            yield attempt, decode_record(f"{storage.url}/{key}", data, model)


def _end_of_held(
    union: Union,
    holding: Holding,
    commit: Commit,
    start: AttemptStart | None,
    ends: list[LedgerEntry],
    is_kept: bool,
) -> LedgerEntry:
    """The end record of an attempt that made a shard, with its commit's cost, also without a ledger entry."""
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
    """The most informative of several ends of one attempt: with cost, and a guess only where all are."""
    return end.cost is None, end.cause == GUESS_CAUSE, encode_record(end)
