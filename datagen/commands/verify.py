"""`datagen verify`: check every record and every byte of a run; repair it, replay scenes, or clean it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from datagen.console.command_lines import command_line
from datagen.console.options import AS_FOUND, AsJson, AssetSources, RunPath, Sources, Whole
from datagen.console.printing import counted, listed, print_json, print_lines, print_rows, seconds, size
from datagen.display.progress import counting
from datagen.exports.export_record import EXPORT, ExportRecord, check_export, read_export
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding
from datagen.schemas.checking.repair import Cleaned, Repaired, clean_runs, refuse_running, repair_runs
from datagen.schemas.errors import InputError, printable
from datagen.schemas.storage import Storage, open_storage

_KEPT = 10_000  # findings that are listed; all are counted
_SHOWN = 50  # findings on a terminal


def verify(
    run: RunPath,
    /,
    *,
    repair: bool = False,
    replay: Whole = 0,
    clean: bool = False,
    given: AssetSources = AS_FOUND,
    json: AsJson = False,
) -> int:
    """Check a run: every record and its copy, every file and its rows, the ledger, the sealed store.

    Each finding names the file, the problem and the fix. Exit code 0 when there is no damage, else 1. No file
    is written without --repair or --clean, which are refused while a job of the run may be alive. Of an
    export, check its files, and that its run has not changed since.

    For example: datagen verify runs/first

    Args:
        repair: Restore records from their copies, move damaged shards into set-aside/, and seal the run
            again. `datagen resume` then makes these shards again.
        replay: Number of scenes to make again from specification and assets, evenly spaced over the run, and
            to compare bit for bit.
        clean: Remove files that no record names and that are older than an hour: of unfinished or
            superseded attempts.
    """
    if not 0 <= replay <= 1_000_000:
        raise InputError("--replay", str(replay), "is not between 0 and 1,000,000", "Give a number of scenes")
    storage = open_storage(run, probe=False, create=False)
    if (exported := read_export(storage)) is not None:
        if repair or replay or clean:
            fix = "Give it for the run, or run the same `datagen export` again"
            raise InputError(run, EXPORT, "is an export, of which there is nothing to repair or replay", fix)
        return _verify_export(storage, exported, json)
    if clean:
        refuse_running(storage)  # before the check, which takes time
    checked, found, repaired, cleaned = Checked(), _Found(), None, None
    with counting("shards checked", as_json=json) as seen:
        if repair:
            repaired = repair_runs(storage, seen)
            checked = repaired.checked
            found.take(repaired.left)
        else:
            found.take(check_runs(storage, checked, seen))
    scenes = 0
    if replay and checked.samples and not found.damage:
        scenes = _replay(storage, checked, found, replay, given, json)
    if clean:
        with counting("shards searched", as_json=json) as seen:
            cleaned = clean_runs(storage, seen)
    report = _report(run, checked, found, repaired, cleaned)
    report["replay"] = {"asked": replay, "scenes": scenes, "done": scenes > 0} if replay else None
    if json:
        print_json(report)
    else:
        _print(report, checked, found, repaired)
    return 1 if found.damage else 0


def _verify_export(storage: Storage, record: ExportRecord, json: bool) -> int:
    found = [{"file": file, "problem": problem} for file, problem in check_export(storage, record)]
    files = f"{counted(len(record.files), 'file')}, every byte"
    clean = f"clean: {storage.url} is the {record.format} export of {record.run} ({files})"
    if json:
        print_json({"export": storage.url, "run": record.run, "clean": not found, "findings": found})
    else:
        print_lines("\n".join("{file}: {problem}".format(**each) for each in found) or clean)
    return 1 if found else 0


def _replay(
    storage: Storage, checked: Checked, found: _Found, count: int, given: AssetSources, json: bool
) -> int:
    """Add the findings of `count` scenes, or of all if there are fewer; return how many were made again."""
    # Simulators are imported only for --replay.
    from datagen.replaying import replay_findings

    sources = Sources(houses=given.houses, objects=given.objects, robot=given.robot)
    done = 0
    with counting("scenes made again", as_json=json) as seen:

        def count_scene(number: int, of: int) -> None:
            nonlocal done
            done = number
            seen(number, of)

        for run, finding in replay_findings(checked.runs, count, sources, count_scene):
            folder = run.storage.url.removeprefix(storage.url).strip("/")
            found.take([replace(finding, key=f"{folder}/{finding.key}".strip("/"))])
    return done


class _Found:
    """Findings as they are found: all are counted, the first are kept."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.kept: list[Finding] = []

    def take(self, findings: Iterable[Finding]) -> None:
        for finding in findings:
            self.counts[finding.kind] += 1
            if len(self.kept) < _KEPT:
                self.kept.append(finding)

    @property
    def damage(self) -> int:
        """Number of findings that are damage."""
        return self.counts.total() - self.counts["stale"]


def _finding_row(finding: Finding) -> dict[str, Any]:
    fields = {name: getattr(finding, name) for name in ("kind", "problem", "fix", "shard")}
    return {"file": finding.key, **fields, "repairable": finding.cure is not None}


def _report(
    run: str, checked: Checked, found: _Found, repaired: Repaired | None, cleaned: Cleaned | None
) -> dict[str, Any]:
    totals = checked.totals
    return {
        "run": run,
        "clean": not found.damage,
        "shards": checked.shards,
        "bytes": checked.bytes,
        "samples": checked.samples,
        "sealed": checked.is_sealed,
        "shards_of_other_code": checked.of_other_code,
        "seal_is_stale": found.counts["stale"] > 0,
        "ledger": {
            "attempts": totals.attempts,
            "running": totals.unfinished,
            "without_account": totals.without_account,
            "wall_s": totals.committed_wall_s + totals.wasted_wall_s,
            "commits_wall_s": totals.committed_wall_s,
            "waste_wall_s": totals.wasted_wall_s,
        },
        "repaired": None
        if repaired is None
        else {
            "restored": sorted(repaired.restored),
            "set_aside": sorted(repaired.set_aside),
            "into": repaired.into if repaired.set_aside else "",
            "sealed": repaired.resealed,
        },
        "removed": None if cleaned is None else {"files": cleaned.files, "bytes": cleaned.bytes},
        "counts": dict(sorted(found.counts.items())),
        "findings": [_finding_row(finding) for finding in found.kept],
    }


def _print(report: dict[str, Any], checked: Checked, found: _Found, repaired: Repaired | None) -> None:
    totals = checked.totals
    wall_s = totals.committed_wall_s + totals.wasted_wall_s
    attempts = counted(totals.attempts, "attempt")
    rows = [
        ("shards", f"{checked.shards:,}, {size(checked.bytes)}, every byte"),
        ("samples", f"{checked.samples:,}, with correct ids"),
        (
            "ledger",
            f"{attempts}: {seconds(wall_s)} = {seconds(totals.committed_wall_s)} in commits"
            f" + {seconds(totals.wasted_wall_s)} waste",
        ),
        ("sealed", "yes" if checked.is_sealed else "no"),
    ]
    if checked.of_other_code:
        made = f"{counted(checked.of_other_code, 'shard')} made by other code than began the run"
        rows.append(("note", f"{made}, of the same label and engine versions"))
    if repaired is not None:
        rows.append(("restored", counted(len(repaired.restored), "record")))
        rows.append(("set aside", listed(sorted(repaired.set_aside)) or "nothing"))
        if repaired.set_aside:
            again = command_line(["resume", report["run"]])
            rows.append(("", f"now in {repaired.into}; to make shards again: {again}"))
    if (replay := report["replay"]) is not None:
        done = f"{counted(replay['scenes'], 'scene')} made again and compared bit for bit"
        rows.append(("replay", done if replay["done"] else "not done: repair the run first"))
    if (removed := report["removed"]) is not None:
        rows.append(("removed", f"{counted(removed['files'], 'leftover file')}, {size(removed['bytes'])}"))
    state = "clean" if not found.damage else counted(found.damage, "finding")
    print_rows(f"{state}: {report['run']}", rows)
    _print_findings(found.kept, found.counts.total())


def _print_findings(findings: list[Finding], total: int) -> None:
    """List the findings: the file, and below it the problem and the fix."""
    if not findings:
        return
    lines = ["found: the file, the problem, the fix"]
    for finding in findings[:_SHOWN]:
        lines += [f"  {printable(finding.key)}", f"      {printable(f'{finding.problem}. {finding.fix}')}"]
    if total > _SHOWN:
        lines.append(f"  and {total - _SHOWN:,} more: --json lists them")
    print_lines("\n".join(lines))
