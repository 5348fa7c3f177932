"""`datagen verify`: check every record and every byte of a run."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from datagen.console.options import AS_FOUND, AsJson, RunPath, Sources, Whole
from datagen.console.printing import counted, print_json, print_lines, print_rows, seconds, size
from datagen.display.progress import counting
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding
from datagen.schemas.errors import InputError, printable
from datagen.schemas.run import Run
from datagen.schemas.storage import Storage, open_storage

_KEPT = 10_000  # findings that are listed; all are counted
_SHOWN = 50  # of them on a terminal


def verify(
    run: RunPath,
    /,
    *,
    deep: Whole = 0,
    seed: Whole | None = None,
    given: Sources = AS_FOUND,
    json: AsJson = False,
) -> int:
    """Check a run: every record and its copy, every file and its rows, the ledger, the sealed store.

    No file is written. Each finding names the file, the problem and the fix. Exit code 0 when there is no
    damage, else 1. With --deep, labels are also computed again.

    For example: datagen verify runs/first

    Args:
        deep: Number of random samples and of random scenes to compute again.
        seed: Seed of the samples and scenes of --deep [random].
    """
    if not 0 <= deep <= 1_000_000:
        raise InputError("--deep", str(deep), "is not between 0 and 1,000,000", "Give a number of samples")
    storage = open_storage(run, probe=False, create=False)
    checked, found = Checked(), Found()
    with counting("shards checked", as_json=json) as seen:
        found.take(check_runs(storage, checked, seen))
    chosen = secrets.randbits(32) if seed is None else seed
    recomputed = deep > 0 and not found.damage
    if recomputed:
        found.take(_deep(storage, checked.runs, deep, chosen, given))
    report = _report(run, checked, found)
    report["deep"] = {"asked": deep, "done": recomputed, "seed": chosen} if deep else None
    if json:
        print_json(report)
    else:
        _print(report, checked, found)
    return 1 if found.damage else 0


class Found:
    """Findings as they are found: all are counted, the first are kept."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.kept: list[Finding] = []

    def take(self, findings: Iterable[Finding]) -> None:
        """Count the findings and keep the first."""
        for finding in findings:
            self.counts[finding.kind] += 1
            if len(self.kept) < _KEPT:
                self.kept.append(finding)

    @property
    def damage(self) -> int:
        """Number of findings that are damage."""
        return self.counts.total() - self.counts["stale"]


def _deep(storage: Storage, runs: list[Run], count: int, seed: int, given: Sources) -> Iterator[Finding]:
    """Findings of samples and scenes computed again, divided among the runs."""
    # Simulators are imported only for --deep.
    from datagen.regeneration.deep_check import deep_findings
    from datagen.regeneration.scenes import open_sources

    rng = np.random.default_rng(seed)
    shares = np.full(len(runs), count // len(runs))
    shares[: count % len(runs)] += 1
    for run, share in zip(runs, shares.tolist(), strict=True):
        origin = open_sources(run, given, needs_scenes=False)
        folder = run.storage.url.removeprefix(storage.url).strip("/")
        for finding in deep_findings(run, share, origin, rng):
            yield replace(finding, key=f"{folder}/{finding.key}".strip("/"))


def finding_row(finding: Finding) -> dict[str, Any]:
    """A finding as plain values."""
    fields = {name: getattr(finding, name) for name in ("kind", "problem", "fix", "shard")}
    return {"file": finding.key, **fields, "repairable": finding.cure is not None}


def _report(run: str, checked: Checked, found: Found) -> dict[str, Any]:
    totals = checked.totals
    return {
        "run": run,
        "clean": not found.damage,
        "shards": checked.shards,
        "files": checked.files,
        "bytes": checked.bytes,
        "samples": checked.samples,
        "sealed": checked.is_sealed,
        "seal_is_stale": found.counts["stale"] > 0,
        "ledger": {
            "attempts": totals.attempts,
            "running": totals.unfinished,
            "without_account": totals.without_account,
            "wall_s": totals.committed_wall_s + totals.wasted_wall_s,
            "commits_wall_s": totals.committed_wall_s,
            "waste_wall_s": totals.wasted_wall_s,
        },
        "counts": dict(sorted(found.counts.items())),
        "findings": [finding_row(finding) for finding in found.kept],
    }


def _print(report: dict[str, Any], checked: Checked, found: Found) -> None:
    totals = checked.totals
    wall_s = totals.committed_wall_s + totals.wasted_wall_s
    files, attempts = counted(checked.files, "file"), counted(totals.attempts, "attempt")
    rows = [
        ("shards", f"{checked.shards:,}, {files} of {size(checked.bytes)}, every byte"),
        ("samples", f"{checked.samples:,}, with correct ids"),
        (
            "ledger",
            f"{attempts}: {seconds(wall_s)} = {seconds(totals.committed_wall_s)} in commits"
            f" + {seconds(totals.wasted_wall_s)} waste",
        ),
        ("sealed", "yes" if checked.is_sealed else "no"),
    ]
    deep = report["deep"]
    if deep:
        count = deep["asked"]
        done = f"{counted(count, 'sample')} and {counted(count, 'scene')} computed again"
        rows.append(
            ("deep", f"{done} (--seed {deep['seed']})" if deep["done"] else "not done: repair the run first")
        )
    state = "clean" if not found.damage else counted(found.damage, "finding")
    print_rows(f"{state}: {report['run']}", rows)
    print_findings("found", found.kept, sum(found.counts.values()))


def print_findings(title: str, findings: list[Finding], total: int) -> None:
    """List the findings: the file, and below it the problem and the fix."""
    if not findings:
        return
    lines = [f"{title}: the file, the problem, the fix"]
    for finding in findings[:_SHOWN]:
        lines += [f"  {printable(finding.key)}", f"      {printable(f'{finding.problem}. {finding.fix}')}"]
    if total > _SHOWN:
        lines.append(f"  and {total - _SHOWN:,} more: --json lists them")
    print_lines("\n".join(lines))
