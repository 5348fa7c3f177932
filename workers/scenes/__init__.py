"""Scenes: where things are put, how they come to rest, and from where they are seen."""
