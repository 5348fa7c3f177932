"""`datagen doctor`: check this machine, and show how to fix each problem."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from datagen.console.options import AsJson
from datagen.console.printing import print_json
from datagen.doctor.check import Check, Status
from datagen.doctor.engines import arm_checks, engine_checks
from datagen.doctor.host import host_checks
from datagen.schemas.errors import InputError
from datagen.workers.extras import EXTRAS, how_to_get

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def _count(name: str, ref: str, names: Callable[[], Sequence[str]]) -> Check:
    try:
        n = len(names())
    except InputError as error:
        return Check(name, "fail", f"{error.place}: {error.problem}", error.fix)
    if n == 0:
        return Check(name, "fail", f"{ref}: none", f"Name a folder with {name}.")
    return Check(name, "ok", f"{n} from {ref}")


def asset_checks(houses: str | None, objects: str | None) -> list[Check]:
    """Checks of houses and objects: those given, else those in DATAGEN_ASSETS, else the built-in ones."""
    from datagen.workers.houses import open_houses
    from datagen.workers.objects import open_objects

    root = os.environ.get("DATAGEN_ASSETS")
    if root and houses is None and (Path(root) / "procthor").is_dir():
        houses = f"procthor:{Path(root) / 'procthor'}"
    if root and objects is None and (Path(root) / "ycb").is_dir():
        objects = f"ycb:{Path(root) / 'ycb'}"
    houses, objects = houses or "builtin", objects or "builtin"
    return [
        _count("houses", houses, lambda: open_houses(houses).house_ids()),
        _count("objects", objects, lambda: open_objects(objects).names()),
    ]


def extra_checks() -> list[Check]:
    """One check per extra: its features, and how to install it. Only `labels` is required."""
    checks: list[Check] = []
    for name, extra in EXTRAS.items():
        if missing := extra.missing():
            status: Status = "fail" if name == "labels" else "ok"
            problem = f"not installed ({', '.join(missing)}); would give {extra.gives}"
            checks.append(Check(f"extra {name}", status, problem, how_to_get(name)))
        else:
            checks.append(Check(f"extra {name}", "ok", extra.gives))
    return checks


def as_table(checks: list[Check]) -> Table:
    """A table with one row per check; the fix is below the finding."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for check in checks:
        # Text, because brackets in paths and messages are not markup.
        finding = Text(check.detail)
        if check.fix:
            finding.append(f"\n-> {check.fix}", style="cyan")
        table.add_row(Text(check.status, style=_COLOURS[check.status]), check.name, finding)
    return table


def doctor(*, json: AsJson = False, houses: str | None = None, objects: str | None = None) -> int:
    """Check this machine, and show how to fix what is missing.

    Exit code 0 when labels can be made here, else 1.

    Args:
        houses: Houses to check: builtin, procthor:DIR or ai2thor:DIR.
        objects: Objects to check: builtin or ycb:DIR.
    """
    checks = [*host_checks(), *extra_checks(), *engine_checks(), *arm_checks()]
    if not EXTRAS["labels"].missing():
        checks += asset_checks(houses, objects)
    failures = sum(check.status == "fail" for check in checks)
    if json:
        print_json({"ok": not failures, "checks": [asdict(check) for check in checks]})
    else:
        console = Console(highlight=False)
        console.print(as_table(checks))
        warnings = sum(check.status == "warn" for check in checks)
        verdict = "labels can be made here" if not failures else "labels cannot be made here yet"
        console.print(f"\n{verdict}: {failures} failed, {warnings} warned")
    return 1 if failures else 0
