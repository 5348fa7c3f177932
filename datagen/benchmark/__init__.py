"""The frozen benchmark: reproducible runs, and one evaluation of every method on them."""
