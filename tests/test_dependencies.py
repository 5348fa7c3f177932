"""What pyproject.toml lists by hand is what the installed libraries say."""

from __future__ import annotations

import tomllib
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from tests.sim_extra import needs_sim

_ROOT = Path(__file__).parents[1]
_PYPROJECT = _ROOT / "pyproject.toml"
# The extra `labels` brings them, but for mplib, which has no wheels there and is never imported.
_LISTED_ELSEWHERE = {"numpy", "scipy", "sapien", "trimesh", "mplib"}


def _needed(requirements: list[str], python: str) -> dict[str, Requirement]:
    """Requirements by name that hold on Linux with this Python and without extras."""
    environment = {"python_version": python, "sys_platform": "linux", "platform_system": "Linux", "extra": ""}
    parsed = map(Requirement, requirements)
    return {
        canonicalize_name(r.name): r for r in parsed if r.marker is None or r.marker.evaluate(environment)
    }


def test_pinned_versions_install_on_debian_12() -> None:
    """Its Python is 3.11.2, and some libraries of `3.11 or newer` begin later."""
    pins = [
        line.split("==")[0] for line in (_ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    ]
    asked = {name: _requires_python(name) for name in pins}
    assert len(asked) > 100 and any(asked.values())
    assert not {name: text for name, text in asked.items() if "3.11.2" not in SpecifierSet(text)}


def _requires_python(name: str) -> str:
    """Empty for what is not installed on this Python."""
    try:
        found = metadata(name)
    except PackageNotFoundError:
        return ""
    return "".join(found.get_all("Requires-Python") or [])


@needs_sim
def test_the_extra_sim_lists_what_maniskill_needs() -> None:
    sim = tomllib.loads(_PYPROJECT.read_text())["project"]["optional-dependencies"]["sim"]
    listed = _needed(sim, "3.13").keys() - _needed(sim, "3.12").keys()
    wanted = _needed(requires("mani-skill") or [], "3.13")
    assert sorted(listed) == sorted(wanted.keys() - _LISTED_ELSEWHERE)
    for name in listed:
        ours, theirs = _needed(sim, "3.13")[name], wanted[name]
        assert (ours.extras, ours.specifier) == (theirs.extras, theirs.specifier), name
