"""Computation of shards: geometry, labels and simulators, without Ray and storage."""
