"""Merge ledgers: every attempt once, with its cost.

An attempt is superseded where its shard is kept from another one. Attempts of resharded shards are split
with them, each piece with its share of the cost; unsuccessful ones are kept whole, with their first piece.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

from datagen.schemas.ledger import LOST_CAUSE, end_from_commit, lost_end
from datagen.schemas.merging.plan import Holding, Union
from datagen.schemas.record_files import encode_record
from datagen.schemas.run_records import AttemptStart, LedgerEntry

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
