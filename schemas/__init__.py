"""Everything on disk: errors, fields, specification, manifest, commits, ledger, store."""
