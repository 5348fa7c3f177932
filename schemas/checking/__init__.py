"""Checks of a run on disk that need nothing but the run: records, files, rows, ledger, sealed store."""
