"""Scenes: where things are put, how they come to rest, and from where they are seen."""

# Raised whenever the same specification would give other scenes: a change in how houses and objects
# are read, in placement, viewpoints or clouds. Part of every specification.
VERSION = 1
