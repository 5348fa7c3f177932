"""Where shards run: the driver loop, its policy, and the executors behind it."""
