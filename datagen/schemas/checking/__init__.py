"""Checks of a run on disk without its sources: records, files, rows, ledger, sealed store."""
