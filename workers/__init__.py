"""Computation of shards: geometry, labels and simulators, without Ray and storage."""

if __name__ != "datagen.workers":  # a second name, from a checkout's folder, would define every class twice
    raise ImportError("import it as datagen.workers")
