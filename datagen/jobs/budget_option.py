"""The option --budget: a time, CPU time or money."""

from __future__ import annotations

import re
from pathlib import Path

from datagen.cluster.budget import Budget
from datagen.reports.prices import read_prices
from datagen.schemas.errors import InputError

_AMOUNT = re.compile(r"([0-9]{1,12}(?:\.[0-9]{1,9})?) ?(cpu-)?([A-Za-z]{1,5})")
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_FIX = "Give a time (90min, 2h), CPU time (5cpu-h) or money (3usd)"
_COST_FIX = "Give CPU time (5cpu-h) or money (3usd)"
_MOST_CPU_H = 1_000_000


def parse_budget(text: str, prices: str | Path | None = None, fix: str = _FIX) -> Budget:
    """The budget of a text such as 2h, 90min, 5cpu-h or 3usd; money at the prices of a file [the defaults].

    InputError for another text, for a budget of 0, and for a currency that the prices do not have.
    """
    found = _AMOUNT.fullmatch(text.strip())
    if found is None:
        raise InputError("--budget", text[:40], "is neither a time nor an amount of money", fix)
    amount, of_cpu, unit = float(found[1]), bool(found[2]), found[3].lower()
    if amount == 0:
        raise InputError("--budget", text, "allows nothing", "Give more than 0")
    if unit in _SECONDS:
        limit_s = amount * _SECONDS[unit]
        return Budget(text, spending=limit_s) if of_cpu else Budget(text, wall_s=limit_s)
    if of_cpu or len(unit) != 3:
        raise InputError("--budget", text, f"has the unknown unit {found[3]}", fix)
    known = read_prices(prices)
    if unit != known.currency.lower():
        fix = f"Give {known.currency.lower()}, or --prices FILE with prices in {unit.upper()}"
        raise InputError(
            "--budget", text, f"is in {unit.upper()}, but the prices are in {known.currency}", fix
        )
    return Budget(text, None, amount, known.cost_of(cpu_s=1.0), known.cost_of(stored_bytes=1.0))


def budget_cpu_h(text: str, prices: str | Path | None = None) -> float:
    """Core-hours that a budget of CPU time or money pays for, without the price of storage.

    InputError as from `parse_budget`, for a time, and for more than 1,000,000 core-hours.
    """
    budget = parse_budget(text, prices, _COST_FIX)
    if budget.spending is None:
        raise InputError("--budget", text, "is a time, in which any number of cores may work", _COST_FIX)
    cpu_h = budget.spending / budget.per_cpu_s / 3600 if budget.per_cpu_s else float("inf")
    if cpu_h > _MOST_CPU_H:
        raise InputError("--budget", text, f"pays for more than {_MOST_CPU_H:,} core-hours", "Give less")
    return cpu_h
