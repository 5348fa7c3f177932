"""Each package stays within its budget of lines and syntax nodes (`[tool.budgets]` in pyproject.toml)."""

from __future__ import annotations

import tomllib

from scripts.measures import ROOT, lines_and_nodes

BUDGETS: dict[str, list[int]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["budgets"]
FIX = "Remove code, or raise the budget and say why in docs/development/decisions.md"


def test_each_package_is_within_its_budget() -> None:
    lines, nodes = lines_and_nodes(ROOT)
    assert sorted(lines) == sorted(BUDGETS), "a package without a budget, or a budget without a package"
    over = [
        f"{name} has {lines[name]:,} lines and {nodes[name]:,} nodes, its budget {most}. {FIX}"
        for name, most in BUDGETS.items()
        if lines[name] > most[0] or nodes[name] > most[1]
    ]
    assert not over, "\n".join(over)
