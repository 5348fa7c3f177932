"""Stages of training: a plain loop over batches, and checkpoints that go on exactly where they stopped."""
