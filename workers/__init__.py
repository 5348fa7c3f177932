"""What one shard is: pure geometry and labels, and simulators behind small functions. No Ray, no store."""

if __name__ != "datagen.workers":  # in a checkout's folder the other name would make every class twice
    raise ImportError("import it as datagen.workers")
