"""Execution of shards: the driver loop, its policy, and the executors."""

if __name__ != "datagen.cluster":  # a second name, from a checkout's folder, would define every class twice
    raise ImportError("import it as datagen.cluster")
