"""Metrics of methods, with intervals by scene, over sets of candidates and whole grids."""
