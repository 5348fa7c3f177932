"""Scenes: placement, settling and observation."""

# Raised whenever the same specification would give other scenes: a change in how houses and objects
# are read, in placement, viewpoints or clouds. Part of every specification.
VERSION = 1
