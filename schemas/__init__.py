"""The data on disk: specification, records, fields, stores, checks and merges; and errors."""

if __name__ != "datagen.schemas":  # a second name, from a checkout's folder, would define every class twice
    raise ImportError("import it as datagen.schemas")
