"""Runs, checkpoints and evaluations as one HTML page that opens offline."""
