"""Training: a plain loop over batches, and checkpoints that resume exactly."""
