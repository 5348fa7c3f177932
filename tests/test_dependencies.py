"""What pyproject.toml lists by hand is what the installed libraries say."""

from __future__ import annotations

import tomllib
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.sim_extra import needs_sim

_PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
# The extra `labels` brings them, but for mplib, which has no wheels there and is never imported.
_LISTED_ELSEWHERE = {"numpy", "scipy", "sapien", "trimesh", "mplib"}


def _needed(requirements: list[str], python: str) -> dict[str, Requirement]:
    """Requirements by name that hold on Linux with this Python and without extras."""
    environment = {"python_version": python, "sys_platform": "linux", "platform_system": "Linux", "extra": ""}
    parsed = map(Requirement, requirements)
    return {
        canonicalize_name(r.name): r for r in parsed if r.marker is None or r.marker.evaluate(environment)
    }


@needs_sim
def test_the_extra_sim_lists_what_maniskill_needs() -> None:
    sim = tomllib.loads(_PYPROJECT.read_text())["project"]["optional-dependencies"]["sim"]
    listed = _needed(sim, "3.13").keys() - _needed(sim, "3.12").keys()
    wanted = _needed(requires("mani-skill") or [], "3.13")
    assert sorted(listed) == sorted(wanted.keys() - _LISTED_ELSEWHERE)
    for name in listed:
        ours, theirs = _needed(sim, "3.13")[name], wanted[name]
        assert (ours.extras, ours.specifier) == (theirs.extras, theirs.specifier), name
