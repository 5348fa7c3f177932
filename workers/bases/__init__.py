"""Base poses: where a robot may be asked to stand, and whether its body fits there."""
