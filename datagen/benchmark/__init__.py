"""The frozen benchmark: runs that everybody makes alike, and one evaluation of every method on them."""
