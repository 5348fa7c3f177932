"""The data on disk: specification, records, fields, stores, checks and merges; and errors."""
