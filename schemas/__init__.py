"""Everything on disk: errors, fields, specification, manifest, commits, ledger, store."""

if __name__ != "datagen.schemas":  # in a checkout's folder the other name would make every class twice
    raise ImportError("import it as datagen.schemas")
