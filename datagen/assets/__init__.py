"""Houses and objects on disk: where they come from, what they must be, and getting them safely."""
