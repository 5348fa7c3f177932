"""Base poses: candidates around the target, and their clearance."""
