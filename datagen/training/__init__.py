"""Options of `datagen train`."""
