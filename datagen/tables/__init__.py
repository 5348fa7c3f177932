"""Runs as tables for people: an xarray Dataset of all arrays, and a pandas table of candidates."""
