"""Relabel runs by other parameters of the heuristic, sharing their files."""
