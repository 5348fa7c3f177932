"""Where shards run: the driver loop, its policy, and the executors behind it."""

if __name__ != "datagen.cluster":  # in a checkout's folder the other name would make every class twice
    raise ImportError("import it as datagen.cluster")
