"""What the verb `train` reads from its options."""
