"""Runs and checkpoints as one HTML page that opens offline."""
