"""Execution of shards: the driver loop, its policy, and the executors."""
