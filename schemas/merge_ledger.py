"""The ledgers of merged runs as one: every attempt once, and what was paid for it.

An attempt whose shard was kept from another one is superseded. Attempts at shards that are cut are cut with
them, each piece with its share of the cost; those that made nothing stay whole, at their first piece.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass

from schemas.merge_plan import Holding, Union
from schemas.record_files import encode_record
from schemas.run_records import AttemptStart, LedgerEntry

SPARE_CAUSE = "merged: this shard is held from another attempt"
LOST_CAUSE = "merged: it left no end, and its shard was decided without it"


@dataclass(frozen=True)
class UnitedAttempt:
    """All that the union says of one attempt; `end` is None while it has not ended."""

    name: str
    start: AttemptStart | None
    end: LedgerEntry | None


@dataclass(frozen=True)
class _Place:
    """Where a source speaks of an attempt: its name there, and the piece of it that is meant."""

    source: int
    attempt: str
    piece: int | None  # shard of the union; None for the whole attempt


def united_attempts(union: Union, given_up: Container[int] = ()) -> Iterator[UnitedAttempt]:
    """Every attempt of the union in order of names; records are read as they are asked for.

    One that left no end is lost, at a cost that nobody knows, where its shard is kept or `given_up`.
    """
    held = {holding.name: holding for holdings in union.spare.values() for holding in holdings}
    kept = {holding.name: holding for holding in union.kept.values()}
    places = _places(union)
    for name in sorted(places):
        starts = [start for place in places[name] if (start := _start(union, name, place)) is not None]
        start = min(starts, key=encode_record) if starts else None
        ends = [end for place in places[name] if (end := _end(union, name, place)) is not None]
        if name in kept:
            yield UnitedAttempt(name, start, _end_of_held(union, kept[name], start, ends, is_kept=True))
        elif name in held:
            yield UnitedAttempt(name, start, _end_of_held(union, held[name], start, ends, is_kept=False))
        else:
            if start is not None and not ends and (start.shard in union.kept or start.shard in given_up):
                ends.append(_lost(start))
            yield UnitedAttempt(name, start, min(ends, key=_account_first) if ends else None)


def _places(union: Union) -> dict[str, list[_Place]]:
    found: dict[str, list[_Place]] = {}
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
                found.setdefault(name, []).append(_Place(source, attempt, piece))
    return found


def _start(union: Union, name: str, place: _Place) -> AttemptStart | None:
    start = union.runs[place.source].ledger.start_of(place.attempt)
    if start is None:
        return None
    shard = union.cut(place.source).first(start.shard) if place.piece is None else place.piece
    return start.model_copy(update={"attempt": name, "shard": shard})


def _end(union: Union, name: str, place: _Place) -> LedgerEntry | None:
    end = union.runs[place.source].ledger.end_of(place.attempt)
    if end is None:
        return None
    cut = union.cut(place.source)
    if place.piece is None:
        return end.model_copy(update={"attempt": name, "shard": cut.first(end.shard)})
    cost = None if end.cost is None else cut.cost(end.cost, place.piece)
    return end.model_copy(update={"attempt": name, "shard": place.piece, "cost": cost})


def _end_of_held(
    union: Union, holding: Holding, start: AttemptStart | None, ends: list[LedgerEntry], is_kept: bool
) -> LedgerEntry:
    """How an attempt that made a shard ended, at its commit's cost, also where no ledger says so."""
    commit = union.commit_of(holding)
    truth = {
        "outcome": "committed" if is_kept else "superseded",
        "cause": "" if is_kept else SPARE_CAUSE,
        "stack": "",
        "cost": union.cost_of(holding, commit),
    }
    bare = LedgerEntry(
        attempt=holding.name,
        shard=holding.shard,
        outcome="committed",
        started=start.started if start else "",
        ended=commit.created,
        host=commit.host,
    )
    # What was worked out from the commit comes last: merging again must not prefer it to what was noted.
    derived = bare.model_copy(update=truth)
    noted = [end.model_copy(update={**truth, "host": end.host or commit.host}) for end in ends]
    return min([*noted, derived], key=lambda end: (end == derived, encode_record(end)))


def _lost(start: AttemptStart) -> LedgerEntry:
    return LedgerEntry(
        attempt=start.attempt, shard=start.shard, outcome="lost", cause=LOST_CAUSE, started=start.started
    )


def _account_first(end: LedgerEntry) -> tuple[bool, bool, bytes]:
    """Which of several ends of one attempt says most: one with its cost, and a guess only where all are."""
    return end.cost is None, end.cause == LOST_CAUSE, encode_record(end)
