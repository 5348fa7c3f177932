"""Scenes: placement, settling and observation."""

from datagen.schemas.specification import Specification

# Raise it whenever the same specification would give other scenes: a change in how houses and objects
# are read, in placement, viewpoints or clouds. Part of every specification.
VERSION = 1
# The same for specifications with `candidates.within`. 2: robots are drawn given that the target has room.
VERSION_WITHIN = 2


def scenes_version(spec: Specification) -> int:
    """The version of the scenes that this specification gives."""
    return VERSION if spec.candidates.within is None else VERSION_WITHIN
